"""A results directory is complete, or not there at all."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import pytest

from vli_bringup.output import ResultsDirectory, ScanDirectory
from vli_common.errors import OutputError


def fill(directory, text="new"):
    (directory / "summary.json").write_text(text)


def test_results_take_their_place_only_when_all_went_well(tmp_path):
    out = tmp_path / "a" / "out"
    with ResultsDirectory(out) as directory:
        fill(directory)
        assert not out.exists()
    assert (out / "summary.json").read_text() == "new"
    assert [item.name for item in (tmp_path / "a").iterdir()] == ["out"]


def run_that_fails(out):
    with ResultsDirectory(out) as directory:
        fill(directory)
        raise KeyError


def test_a_failed_run_leaves_nothing(tmp_path):
    with pytest.raises(KeyError):
        run_that_fails(tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_an_empty_directory_may_be_given(tmp_path):
    (tmp_path / "out").mkdir()
    with ResultsDirectory(tmp_path / "out") as directory:
        fill(directory)
    assert (tmp_path / "out" / "summary.json").exists()


def test_a_filled_directory_is_refused_and_overwrite_is_named(tmp_path):
    fill(tmp_path, "old")
    with pytest.raises(
        OutputError, match=re.escape(f"'{tmp_path}' is not empty; choose another with --out DIR, or") + ".*--overwrite"
    ):
        ResultsDirectory(tmp_path)


def test_overwrite_replaces_the_results_of_an_earlier_run_as_a_whole(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    fill(out, "old")
    (out / "stale.csv").touch()
    with ResultsDirectory(out, overwrite=True) as directory:
        fill(directory)
        assert (out / "summary.json").read_text() == "old"
    assert [item.name for item in out.iterdir()] == ["summary.json"]


def test_overwrite_never_replaces_what_is_not_a_result(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(OutputError, match=r"holds 'thesis.tex' but no 'summary.json'"):
        ResultsDirectory(tmp_path, overwrite=True)


def test_a_file_is_no_place_for_results(tmp_path):
    (tmp_path / "out").touch()
    with pytest.raises(OutputError, match="is a file, expected a directory"):
        ResultsDirectory(tmp_path / "out", overwrite=True)


def test_a_place_that_cannot_be_made_is_one_line(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"cannot be made .*--out DIR"), ResultsDirectory(tmp_path / "file" / "out"):
        pytest.fail("entered")


@pytest.mark.parametrize("name", ["", ".", "/", "..", "a/.."])
def test_what_has_no_name_of_its_own_is_no_place(name):
    with pytest.raises(OutputError, match="is no name for a new directory; choose another with --out DIR"):
        ResultsDirectory(Path(name), overwrite=True)


def test_a_name_that_is_too_long_is_one_line():
    with pytest.raises(OutputError, match=r"cannot be looked at \(File name too long\); choose another with --out DIR"):
        ResultsDirectory(Path("x" * 300))


def test_a_link_is_refused_before_anything_is_computed(tmp_path):
    (tmp_path / "old").mkdir()
    fill(tmp_path / "old")
    (tmp_path / "latest").symlink_to("old")
    with pytest.raises(OutputError, match="is a link, expected a directory"):
        ResultsDirectory(tmp_path / "latest", overwrite=True)


def test_a_write_that_fails_is_said_as_such_and_leaves_nothing(tmp_path):
    with pytest.raises(OutputError, match=r"cannot be written .*No space left"), ResultsDirectory(tmp_path / "out"):
        raise OSError(28, "No space left on device")
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_run_left_is_cleared(tmp_path):
    stale = tmp_path / "out.partial"
    stale.mkdir()
    (stale / "half").touch()
    with ResultsDirectory(tmp_path / "out") as directory:
        fill(directory)
    assert [item.name for item in (tmp_path / "out").iterdir()] == ["summary.json"]


def test_without_a_name_results_are_stamped_and_latest_points_at_the_newest(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for text in ("first", "second"):
        results = ResultsDirectory(None)
        results.path = results.path.with_name(text)
        results.partial = results.path.with_name(text + ".partial")
        with results as directory:
            fill(directory, text)
    assert re.fullmatch(r"results/\d{8}-\d{6}", str(ResultsDirectory(None).path))
    assert (tmp_path / "results" / "latest" / "summary.json").read_text() == "second"
    assert (tmp_path / "results" / "latest").readlink().name == "second"


def cut_off(results: ResultsDirectory, error: BaseException, written: Mapping[str, str]) -> None:
    """Write some files and fail."""
    with results as directory:
        for name, text in written.items():
            (directory / name).parent.mkdir(exist_ok=True)
            (directory / name).write_text(text)
        raise error


def test_a_scan_that_is_cut_off_stays_and_is_not_replaced_unasked(tmp_path, capsys):
    with pytest.raises(KeyboardInterrupt):
        cut_off(ScanDirectory(tmp_path / "out"), KeyboardInterrupt(), {"autosave.vli": "map"})
    assert "what there is of the scan stays in" in capsys.readouterr().err
    assert (tmp_path / "out.partial" / "autosave.vli").read_text() == "map"
    with pytest.raises(OutputError, match=r"holds what is left of a scan that was cut off \(autosave.vli\); rename it"):
        ScanDirectory(tmp_path / "out")
    with ScanDirectory(tmp_path / "out", overwrite=True) as directory:
        fill(directory)
    assert [item.name for item in tmp_path.iterdir()] == ["out"]


def test_a_full_disk_at_the_end_of_a_scan_does_not_cost_what_was_written_before(tmp_path):
    written = {"trajectory.tum": "1", "a/map.vli": "1", "trajectory_final.tum": ""}
    with pytest.raises(OutputError, match=r"No space left on device\); what there is stays there: a/map.vli, trajectory.tum$"):
        cut_off(ScanDirectory(tmp_path / "out"), OSError(28, "No space left on device"), written)
    assert (tmp_path / "out.partial" / "a" / "map.vli").exists()


def test_a_scan_that_fails_before_anything_was_scanned_leaves_nothing(tmp_path):
    with pytest.raises(OutputError, match="not ready"):
        cut_off(ScanDirectory(tmp_path / "out"), OutputError("not ready"), {"config.yaml": "a: 1"})
    assert list(tmp_path.iterdir()) == []
