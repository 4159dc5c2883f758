"""Poses of the graph by session, however the topics overtake each other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vli_bringup.graph_sessions import GraphSessions
from vli_bringup.tum import read_tum
from vli_common.calibration import load_calibration
from vli_common.geometry import pose
from vli_common.types import TrackingState


@pytest.fixture
def sessions(repository: Path) -> GraphSessions:
    return GraphSessions(load_calibration(repository / "bags/demo/calibration.yaml"))


def at(x_m: float) -> np.ndarray:
    return pose(np.eye(3), np.array([x_m, 0.0, 0.0]))


def test_a_pose_belongs_to_the_session_in_which_it_was_published_not_in_which_it_came(
    sessions: GraphSessions, tmp_path: Path
) -> None:
    sessions.begin(1, 1000)
    sessions.at(1500).add_pose(10, at(0.1))
    sessions.begin(2, 2000)
    sessions.at(2500).add_pose(30, at(0.3))
    sessions.at(1999).add_pose(20, at(0.2))
    sessions.begin(2, 3000)
    sessions.at(3500).add_pose(40, at(0.4))
    assert sessions.poses == 4
    assert sessions.write(tmp_path) == {1: tmp_path / "session-1"}
    assert read_tum(tmp_path / "session-1" / "trajectory.tum").stamps_ns.tolist() == [10, 20]
    assert read_tum(tmp_path / "trajectory.tum").stamps_ns.tolist() == [30, 40]


def test_sessions_without_a_pose_leave_nothing_and_do_not_count(sessions: GraphSessions, tmp_path: Path) -> None:
    for number, began_ns in ((0, 0), (1, 1000), (2, 2000), (3, 3000)):
        sessions.begin(number, began_ns)
    sessions.at(2500).add_pose(10, at(0.1))
    sessions.at(3500).add_pose(20, at(0.2))
    assert sessions.write(tmp_path) == {2: tmp_path / "session-1"}


def test_a_back_end_that_is_started_anew_says_zero_until_it_hears_of_the_session(sessions: GraphSessions) -> None:
    sessions.begin(1, 1000)
    sessions.at(1500).add_pose(10, at(0.1))
    for number, began_ns in ((0, 2000), (1, 2100), (2, 2200)):
        sessions.begin(number, began_ns)
    sessions.at(2900).add_pose(20, at(0.2))
    assert list(sessions.recorder.live) == [20]


def test_states_are_those_of_all_sessions(sessions: GraphSessions) -> None:
    sessions.begin(1, 1000)
    sessions.recorder.add_state(1, TrackingState.TRACKING, "")
    sessions.begin(2, 2000)
    sessions.recorder.add_state(2, TrackingState.INITIALISING, "move")
    assert [state for _, state, _ in sessions.recorder.states] == ["TRACKING", "INITIALISING"]
    assert sessions.recorder.reason == "move"


def test_poses_that_come_before_any_status_are_recorded(sessions: GraphSessions) -> None:
    sessions.at(500).add_pose(10, at(0.1))
    sessions.begin(0, 600)
    assert list(sessions.recorder.live) == [10]


def test_the_last_window_of_a_session_belongs_to_it_even_where_the_next_was_told_before(sessions: GraphSessions) -> None:
    sessions.begin(1, 1000)
    first = sessions.recorder
    sessions.begin(2, 2000)
    assert sessions.of_window(1, 2100) is first
    assert sessions.of_window(2, 2200) is sessions.recorder
    assert sessions.of_window(10**12, 2300) is sessions.recorder
