"""The path on the disk while a graph scans, and what of it stays when the results are there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vli_bringup.graph_sessions import GraphSessions
from vli_bringup.path_saves import PathSaves
from vli_bringup.tum import read_tum
from vli_common.calibration import load_calibration
from vli_common.geometry import pose


@pytest.fixture
def sessions(repository: Path) -> GraphSessions:
    return GraphSessions(load_calibration(repository / "bags/demo/calibration.yaml"))


def add(sessions: GraphSessions, *stamps_ns: int) -> None:
    for stamp_ns in stamps_ns:
        sessions.recorder.add_pose(stamp_ns, pose(np.eye(3), np.array([1e-9 * stamp_ns, 0.0, 0.0])))


def saved(directory: Path) -> dict[str, list[int]]:
    return {path.name: read_tum(path).stamps_ns.tolist() for path in sorted(directory.iterdir())}


def test_each_save_adds_what_is_new(sessions: GraphSessions, tmp_path: Path) -> None:
    saves = PathSaves(sessions, tmp_path, 1.0)
    saves.save()
    assert saved(tmp_path) == {}
    sessions.begin(1, 1000)
    for new in ((10, 20), (), (30,)):
        add(sessions, *new)
        saves.save()
    assert saved(tmp_path) == {"autosave.tum": [10, 20, 30]}


def test_a_session_that_has_ended_has_a_file_of_its_own_with_all_of_its_poses(sessions: GraphSessions, tmp_path: Path) -> None:
    saves = PathSaves(sessions, tmp_path, 1.0)
    sessions.begin(1, 1000)
    add(sessions, 10)
    saves.save()
    add(sessions, 20)
    sessions.begin(2, 2000)
    saves.save()
    assert saved(tmp_path) == {"autosave_session-1.tum": [10, 20]}
    add(sessions, 30)
    saves.save()
    assert saved(tmp_path) == {"autosave.tum": [30], "autosave_session-1.tum": [10, 20]}
    (tmp_path / "trajectory.tum").write_text("the results\n")
    saves.remove()
    assert [path.name for path in tmp_path.iterdir()] == ["trajectory.tum"]


def test_a_session_that_is_gone_back_to_is_whole(sessions: GraphSessions, tmp_path: Path) -> None:
    saves = PathSaves(sessions, tmp_path, 1.0)
    for number, began_ns, stamp_ns in ((1, 1000, 10), (0, 2000, None), (1, 3000, 20), (2, 4000, 30)):
        sessions.begin(number, began_ns)
        if stamp_ns is not None:
            add(sessions, stamp_ns)
        saves.save()
    assert saved(tmp_path) == {"autosave.tum": [30], "autosave_session-1.tum": [10, 20]}


@pytest.mark.parametrize(("period_s", "names"), [(1.0, ["autosave.tum"]), (0.0, [])])
def test_it_saves_when_it_is_time_or_never(
    sessions: GraphSessions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, period_s: float, names: list[str]
) -> None:
    now_s = 1000.0
    monkeypatch.setattr("vli_bringup.path_saves.time.monotonic", lambda: now_s)
    saves = PathSaves(sessions, tmp_path, period_s)
    add(sessions, 10)
    now_s += 0.5
    saves.look()
    assert saved(tmp_path) == {}
    now_s += 0.6
    saves.look()
    assert list(saved(tmp_path)) == names


def test_a_disk_that_takes_no_more_is_told_of_once_and_does_not_end_the_scan(
    sessions: GraphSessions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = 1000.0
    monkeypatch.setattr("vli_bringup.path_saves.time.monotonic", lambda: now_s)
    saves = PathSaves(sessions, tmp_path / "gone", 1.0)
    for stamp_ns in (10, 20):
        add(sessions, stamp_ns)
        now_s += 2.0
        saves.look()
    told = capsys.readouterr().err
    assert told == f"vli: automatic save: '{tmp_path / 'gone' / 'autosave.tum'}' cannot be written: No such file or directory\n"
