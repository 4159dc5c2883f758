"""``vli eval`` from files to tables, JSON and plots; every bad input is one line."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from trajectories import disturbed, moved, part, wavy, write_tum

from vli_bringup import cli, evaluation
from vli_bringup.consistency import covariance_text
from vli_bringup.report import as_dict
from vli_bringup.trajectory_metrics import align_poses
from vli_common import ply
from vli_common.geometry import pose, so3_exp, transform
from vli_common.types import PointCloud

T_MAP_TRUTH = pose(so3_exp(np.array([0.003, -0.002, 1.3])), np.array([0.5, -2.0, 0.1]))
HEIGHT = 0.0002
GREY = 120


def cloud_of(points: np.ndarray, grey: int) -> PointCloud:
    return PointCloud(0, points.astype(np.float32), np.full((len(points), 3), grey, np.uint8))


def floor(count: int) -> np.ndarray:
    return np.column_stack([np.random.default_rng(count).uniform(0, 0.05, (count, 2)), np.zeros(count)])


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    """Return a directory with ``run/`` and ``truth/`` of a floor, the map 0.2 mm above it, half of it missing."""
    run, truth_directory = tmp_path / "run", tmp_path / "truth"
    run.mkdir()
    truth_directory.mkdir()
    truth = wavy()
    write_tum(truth_directory / "truth.tum", truth)
    frames = part(truth, slice(40, None, 2))
    write_tum(run / "trajectory.tum", moved(disturbed(frames, 1), T_MAP_TRUTH))
    write_tum(run / "trajectory_final.tum", moved(frames, T_MAP_TRUTH))
    corners = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]])
    ply.write_mesh(truth_directory / "surface.ply", ply.Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]])))
    seen = floor(20_000)
    ply.write_cloud(truth_directory / "seen.ply", cloud_of(seen, GREY))
    half = seen[seen[:, 0] < 0.025] + [0, 0, HEIGHT]
    ply.write_cloud(run / "map.ply", cloud_of(transform(T_MAP_TRUTH, half), GREY - 51))
    seconds = (truth.stamps_ns[[0, 200, 399]] / 1e9).tolist()
    (truth_directory / "passes.json").write_text(json.dumps({"length_m": 0.2, "passes": [seconds[:2], seconds[1:]]}))
    (run / "summary.json").write_text(json.dumps({"ms_per_frame_mean": 7.25, "ms_per_frame_p95": 12.0, "realtime_factor": None}))
    return tmp_path


def evaluate(scan: Path, *arguments: str) -> int:
    return cli.main(["eval", *arguments_of(scan, *arguments)])


def arguments_of(scan: Path, *arguments: str) -> list[str]:
    return [str(scan / "run"), "--truth", str(scan / "truth" / "truth.tum"), *arguments]


def result_of(scan: Path, *arguments: str) -> evaluation.Result:
    """Return the result without drawing plots."""
    parser = argparse.ArgumentParser()
    evaluation.add_arguments(parser)
    args = parser.parse_args(arguments_of(scan, *arguments))
    return evaluation.evaluate(evaluation.find_sources(args), args.poses_from)


def figures_of(scan: Path, *arguments: str) -> dict[str, float]:
    """Return the figures; what could not be computed is NaN, for comparisons."""
    figures = as_dict(result_of(scan, *arguments).figures)
    return {key: math.nan if value is None else value for key, value in figures.items()}


def test_the_figures_of_a_known_case(scan: Path) -> None:
    figures = figures_of(scan, "--poses-from", "0")
    assert figures["final_translation_max_mm"] == pytest.approx(0, abs=1e-6)
    assert figures["final_rotation_max_rad"] == pytest.approx(0, abs=1e-6)
    assert figures["translation_rmse_mm"] > 0.05
    assert figures["absolute_drift_percent"] > 0
    assert figures["map_point_to_plane_rmse_mm"] == pytest.approx(1e3 * HEIGHT, abs=1e-3)
    assert figures["beyond_0_5mm_percent"] == 0
    assert figures["completeness_percent"] == pytest.approx(50, abs=2)
    assert figures["colour_rmse"] == pytest.approx(0.2)
    assert figures["colour_rmse_gain_compensated"] == pytest.approx(0, abs=1e-9)
    assert figures["poses_share_percent"] == pytest.approx(100 * 180 / 200)
    assert figures["points"] == pytest.approx(10_000, rel=0.05)
    assert figures["ms_per_frame_mean"] == 7.25
    assert math.isnan(figures["realtime_factor"])


def test_covariances_beside_the_trajectory_give_its_nees(scan: Path) -> None:
    assert math.isnan(figures_of(scan)["position_nees"])
    stamps = wavy().stamps_ns[40::2].tolist()
    write(covariance_text(dict.fromkeys(stamps, 1e-6 * np.eye(6))), "run", "covariance.csv")(scan)
    wide = figures_of(scan)["position_nees"]
    write(covariance_text(dict.fromkeys(stamps, 1e-8 * np.eye(6))), "run", "covariance.csv")(scan)
    assert figures_of(scan)["position_nees"] == pytest.approx(100 * wide)
    assert figures_of(scan)["position_sigma_mm"] == pytest.approx(np.sqrt(3) * 0.1)


def test_rotation_and_map_are_aligned_by_the_final_trajectory(scan: Path) -> None:
    before = figures_of(scan)
    turn = pose(so3_exp(np.array([0.0, 0, 0.05])), np.zeros(3))
    live = part(wavy(), slice(40, None, 2))
    write_tum(scan / "run" / "trajectory.tum", moved(live, turn @ T_MAP_TRUTH))
    after = figures_of(scan)
    assert after["map_point_to_plane_rmse_mm"] == before["map_point_to_plane_rmse_mm"]
    assert after["rotation_rmse_rad"] == pytest.approx(0.05, abs=1e-6)
    assert after["translation_rmse_mm"] == pytest.approx(0, abs=1e-6)


def test_without_a_final_trajectory_the_live_one_aligns_and_it_is_said(scan: Path) -> None:
    (scan / "run" / "trajectory_final.tum").unlink()
    figures = figures_of(scan)
    assert math.isnan(figures["final_translation_rmse_mm"])
    truth = wavy()
    live = moved(disturbed(part(truth, slice(40, None, 2)), 1), T_MAP_TRUTH)
    T = align_poses(live.poses, truth.poses[40::2]) @ T_MAP_TRUTH
    assert np.abs(T - np.eye(4)).max() > 1e-4  # the alignment does differ from the true one
    assert figures["map_point_to_plane_rmse_mm"] != pytest.approx(1e3 * HEIGHT, abs=1e-3)
    (note,) = result_of(scan).notes
    assert "trajectory_final.tum' does not exist: the live trajectory aligns" in note


def test_what_stands_next_to_the_truth_is_used_and_said(scan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate(scan) == 0
    said = capsys.readouterr().err
    for name in ("surface.ply", "seen.ply", "passes.json"):
        assert f"used '{scan / 'truth' / name}', next to the truth" in said


def test_what_is_given_goes_before_what_stands_there(scan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    elsewhere = scan / "other.ply"
    ply.write_cloud(elsewhere, cloud_of(floor(500) + np.array([0, 0, 0.3]), GREY))
    assert evaluate(scan, "--seen", str(elsewhere)) == 0
    assert "seen.ply" not in capsys.readouterr().err
    assert figures_of(scan, "--seen", str(elsewhere))["completeness_percent"] == 0


def test_the_truth_alone_is_enough(scan: Path) -> None:
    for name in ("surface.ply", "seen.ply", "passes.json"):
        (scan / "truth" / name).unlink()
    (scan / "run" / "summary.json").unlink()
    figures = figures_of(scan)
    for key in ("map_point_to_plane_rmse_mm", "completeness_percent", "absolute_drift_percent", "ms_per_frame_mean"):
        assert math.isnan(figures[key])
    assert figures["points"] > 0
    assert evaluate(scan) == 0
    assert not (scan / "run" / "eval" / "map.png").exists()


def test_a_run_without_a_map_has_the_figures_of_its_trajectory(scan: Path) -> None:
    complete = figures_of(scan)
    (scan / "run" / "map.ply").unlink()
    figures = figures_of(scan)
    assert figures.keys() == complete.keys()
    assert figures["translation_rmse_mm"] == complete["translation_rmse_mm"]
    assert math.isnan(figures["points"])
    assert math.isnan(figures["completeness_percent"])
    (note,) = result_of(scan).notes
    assert "no figures of a map" in note


def test_an_empty_map_covers_nothing(scan: Path) -> None:
    ply.write_cloud(scan / "run" / "map.ply", cloud_of(np.empty((0, 3)), GREY))
    figures = figures_of(scan)
    assert (figures["points"], figures["completeness_percent"]) == (0, 0)
    assert math.isnan(figures["map_point_to_plane_rmse_mm"])
    assert evaluate(scan) == 0


def test_a_cloud_without_colours_has_no_colour_error(scan: Path) -> None:
    ply.write_cloud(scan / "truth" / "seen.ply", cloud_of(floor(500), 255))
    figures = figures_of(scan)
    assert math.isnan(figures["colour_rmse"])
    assert figures["completeness_percent"] > 0


def test_the_tables_show_the_papers_values_beside_ours(scan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures = figures_of(scan)
    assert evaluate(scan) == 0
    text = capsys.readouterr().out
    rows = {cells[0]: cells[1:] for line in text.splitlines() if (cells := [c.strip() for c in line.strip("|").split("|")])}
    live, final = rows["translation RMSE / max, mm"][3:]
    assert rows["translation RMSE / max, mm"][:3] == ["51 / 86", "3.9 / 8.6", "3.2 / 6.0"]
    assert live == f"{figures['translation_rmse_mm']:.3f} / {figures['translation_max_mm']:.3f}"
    assert final == "0.000 / 0.000"
    assert rows["point-to-plane RMSE, mm"] == ["2.0", "0.93", "0.76", f"{figures['map_point_to_plane_rmse_mm']:.3f}"]
    drift = rows["rotation drift, 1e-4 rad/cm"]
    assert float(drift[3]) == pytest.approx(1e4 * figures["rotation_drift_rad_per_m"] / 100, abs=0.006)
    assert len({len(line) for line in text.split("Table II")[0].splitlines() if line.startswith("|")}) == 1
    assert (scan / "run" / "eval" / "report.md").read_text() == text


def test_a_trajectory_that_flew_away_does_not_take_the_tables_apart(scan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    away = moved(disturbed(part(wavy(), slice(40, None, 2)), 1), T_MAP_TRUTH, 1e15)
    for name in ("trajectory.tum", "trajectory_final.tum"):
        write_tum(scan / "run" / name, away)
    assert evaluate(scan) == 0
    assert max(len(line) for line in capsys.readouterr().out.splitlines()) < 130


def test_the_json_file_has_every_figure_under_a_flat_key_and_null_for_what_is_not_known(scan: Path) -> None:
    figures = figures_of(scan)
    assert evaluate(scan, "--json", str(scan / "figures.json")) == 0
    written = json.loads((scan / "figures.json").read_text())
    assert {key: math.nan if value is None else value for key, value in written.items()} == pytest.approx(figures, nan_ok=True)
    assert written["realtime_factor"] is None
    assert {"absolute_drift_percent", "final_scale_error_percent", "points", "colour_rmse_gain_compensated"} <= written.keys()
    assert (scan / "run" / "eval" / "figures.json").read_bytes() == (scan / "figures.json").read_bytes()


def test_the_plots_are_pictures_with_something_in_them(scan: Path) -> None:
    assert evaluate(scan) == 0
    for name in ("trajectory", "errors", "map"):
        with Image.open(scan / "run" / "eval" / f"{name}.png") as picture:
            pixels = np.asarray(picture.convert("RGB"))
        assert min(pixels.shape[:2]) > 500
        assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 50


def test_two_evaluations_are_the_same(scan: Path) -> None:
    assert evaluate(scan) == 0
    outputs = sorted((scan / "run" / "eval").iterdir())
    first = [path.read_bytes() for path in outputs]
    assert evaluate(scan) == 0
    assert [path.read_bytes() for path in outputs] == first


def remove(*parts: str) -> Callable[[Path], None]:
    return lambda scan: scan.joinpath(*parts).unlink()


def write(content: str, *parts: str) -> Callable[[Path], None]:
    return lambda scan: scan.joinpath(*parts).write_text(content) and None


def shift_truth(scan: Path) -> None:
    truth = wavy()
    truth.stamps_ns[:] += 3_600_000_000_000
    write_tum(scan / "truth" / "truth.tum", truth)


def break_map(scan: Path) -> None:
    points = floor(10)
    points[3, 1] = np.nan
    ply.write_cloud(scan / "run" / "map.ply", cloud_of(points, GREY))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (remove("run", "trajectory.tum"), "holds no 'trajectory.tum', expected the output of 'vli run BAG --calib C --out DIR'"),
        (write("", "run", "trajectory.tum"), "trajectory.tum' holds no pose: tracking never started"),
        (write("1 2 3\n", "run", "trajectory.tum"), "trajectory.tum' line 1: '1 2 3' is not a TUM pose"),
        (write("1 2\n", "run", "trajectory_final.tum"), "trajectory_final.tum' line 1:"),
        (remove("truth", "truth.tum"), "truth.tum' does not exist, expected a TUM file"),
        (shift_truth, "do not overlap in time"),
        (write("not ply", "truth", "surface.ply"), "surface.ply' is no PLY file"),
        (write("not ply", "truth", "seen.ply"), "seen.ply' is no PLY file"),
        (break_map, "map.ply' has '1' points that are not finite"),
        (write("{", "truth", "passes.json"), "passes.json' is not JSON"),
        (write("[]", "truth", "passes.json"), "holds 'list', expected a JSON object"),
        (write("{}", "truth", "passes.json"), "cannot be used (KeyError('passes')), expected {\"passes\": [[start, end], …]}"),
        (write('{"passes": [[1, 2, 3]]}', "truth", "passes.json"), "passes.json' cannot be used"),
        (write('{"passes": [[5, 4]]}', "truth", "passes.json"), "a pass starts at '5.000' and ends at '4.000'"),
        (write("{", "run", "summary.json"), "summary.json' is not JSON"),
        (write("stamp,x\n", "run", "covariance.csv"), "covariance.csv' begin with 'stamp,x', expected"),
    ],
)
def test_a_bad_input_is_one_line_and_exit_code_2(
    scan: Path, capsys: pytest.CaptureFixture[str], damage: Callable[[Path], None], message: str
) -> None:
    damage(scan)
    assert evaluate(scan) == 2
    output = capsys.readouterr()
    lines = output.err.splitlines()
    assert output.out == ""
    assert len(lines) == 1
    assert message in lines[0]


@pytest.mark.parametrize("option", ["--surface", "--seen", "--passes"])
def test_a_file_that_is_named_must_exist(scan: Path, capsys: pytest.CaptureFixture[str], option: str) -> None:
    assert evaluate(scan, option, str(scan / "absent")) == 2
    assert f"{scan / 'absent'}' cannot be read" in capsys.readouterr().err


def test_a_report_that_cannot_be_written_is_told(scan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate(scan, "--json", str(scan / "absent" / "f.json")) == 2
    assert "the report cannot be written" in capsys.readouterr().err
