"""Trajectories as published live and as they left the window; states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vli_bringup.recorder import Recorder, tum_text
from vli_bringup.stamps import seconds_text
from vli_common.calibration import Calibration
from vli_common.camera import make_camera
from vli_common.geometry import inverse, pose, so3_exp
from vli_common.types import BackEndOutput, FrameKind, PoseEstimate, TrackingState, WindowPoses

T_CAM_IMU = pose(so3_exp(np.array([0.1, -0.2, 0.3])), np.array([0.01, 0.02, 0.03]))
CAMERA = make_camera("none", (100.0, 100.0, 50.0, 50.0), (), (100, 100))


@pytest.fixture
def recorder():
    return Recorder(Calibration(CAMERA, 60.0, T_CAM_IMU, 0, None, None))


def body_pose(stamp_ns):
    return pose(so3_exp(np.array([0, 0, 1e-9 * stamp_ns])), np.array([1e-9 * stamp_ns, 2.0, 3.0]))


def output(stamp_ns, state=TrackingState.TRACKING, reason=""):
    estimate = PoseEstimate(stamp_ns, body_pose(stamp_ns), np.eye(4), np.zeros(3), np.zeros(3), np.eye(6))
    return BackEndOutput(stamp_ns, state, reason, estimate if state.has_pose else None)


def window(stamps, kinds, final):
    poses = np.stack([pose(np.eye(3), np.array([stamp, 0.0, 0.0])) for stamp in stamps])
    return WindowPoses(
        stamps[-1], np.array(stamps), np.array(kinds, np.uint8), np.array(final), np.zeros(len(stamps), bool), poses
    )


def lines(path):
    return [line.split() for line in path.read_text().splitlines()]


def test_the_live_trajectory_is_that_of_the_camera(recorder, tmp_path):
    recorder.add([output(1_500_000_000)])
    recorder.write(tmp_path)
    (row,) = lines(tmp_path / "trajectory.tum")
    assert row[0] == "1.500000000"
    np.testing.assert_allclose([float(value) for value in row[1:4]], (body_pose(1.5e9) @ inverse(T_CAM_IMU))[:3, 3], atol=1e-9)
    assert all(len(value.split(".")[1]) == 9 for value in row)


def test_only_states_with_a_pose_are_written(recorder, tmp_path):
    states = [TrackingState.INITIALISING, TrackingState.TRACKING, TrackingState.DEGRADED, TrackingState.LOST]
    recorder.add(output(index, state) for index, state in enumerate(states))
    recorder.write(tmp_path)
    assert [row[0] for row in lines(tmp_path / "trajectory.tum")] == ["0.000000001", "0.000000002"]


def test_the_final_trajectory_has_the_long_frames_that_left_the_window_and_were_published(recorder, tmp_path):
    recorder.add([output(10), output(20), output(40)])
    key, long, short = (kind.value for kind in (FrameKind.KEYFRAME, FrameKind.LONG, FrameKind.SHORT))
    recorder.add([window([5, 10, 15, 20, 40], [key, key, short, long, key], [True, True, True, False, False])])
    recorder.write(tmp_path)
    assert [row[:2] for row in lines(tmp_path / "trajectory_final.tum")] == [["0.000000010", "10.000000000"]]
    recorder.add([window([20, 40], [long, key], [True, True])])
    recorder.write(tmp_path)
    assert [row[1] for row in lines(tmp_path / "trajectory_final.tum")] == ["10.000000000", "20.000000000", "40.000000000"]
    assert recorder.keyframes == 3


def test_what_left_the_window_before_a_relocalisation_is_where_the_map_has_it(recorder, tmp_path):
    key, lost = FrameKind.KEYFRAME.value, pose(so3_exp(np.array([0, 0, 0.5])), np.array([7.0, 8.0, 9.0]))
    recorder.add([output(stamp) for stamp in (1, 2, 3, 4, 5)])
    recorder.add([window([1, 2], [key, key], [True, True])])
    recorder.add([moved(window([3, 4], [key, key], [True, False]), lost, 1)])
    recorder.add([moved(window([4, 5], [key, key], [True, True]), np.eye(4), 2)])
    recorder.write(tmp_path)
    rows = np.array(lines(tmp_path / "trajectory_final.tum"), float)
    np.testing.assert_allclose(rows[:, 1:4], [[1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0], [5, 0, 0]], atol=1e-8)


def moved(poses, T, placement):
    """Return a window as a back end sends it that takes ``T`` for the place of its world in the map."""
    return replace(poses, T_map_camera=T @ poses.T_map_camera, placement=placement)


def test_states_are_listed_when_they_change_and_the_last_reason_is_kept(recorder):
    waiting = TrackingState.INITIALISING
    recorder.add([output(0, waiting, "parallax 1 px"), output(500_000_000, waiting, "parallax 9 px"), output(2_000_000_000)])
    assert recorder.states == [(0.0, "INITIALISING", "parallax 1 px"), (2.0, "TRACKING", "")]
    recorder.add([output(3_000_000_000, TrackingState.LOST, "covered")])
    assert recorder.reason == "covered"


def test_without_poses_the_files_are_empty(recorder, tmp_path):
    recorder.write(tmp_path)
    assert tum_text({}) == (tmp_path / "trajectory_final.tum").read_text() == ""


@pytest.mark.parametrize(
    ("stamp_ns", "text"),
    [(1_700_000_000_123_456_789, "1700000000.123456789"), (5, "0.000000005"), (-1_500_000_000, "-1.500000000")],
)
def test_stamps_keep_every_nanosecond(stamp_ns, text):
    assert seconds_text(stamp_ns) == text
