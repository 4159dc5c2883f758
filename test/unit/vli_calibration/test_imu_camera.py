from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from imu_data import BOARD, NOISE, Moving, moving

from vli_calibration.board_track import BoardTrack, track_board
from vli_calibration.imu_camera import ImuCameraFit, fit_imu_camera
from vli_calibration.imu_camera_alignment import align_rates
from vli_calibration.imu_camera_report import verdict
from vli_calibration.imu_intervals import ImuIntervals
from vli_calibration.imu_recording import make_recording
from vli_calibration.report import Verdict
from vli_calibration.types import Detection
from vli_common.errors import InputError
from vli_common.geometry import pose, so3_log


def track(scene: Moving, sigma_px: float = 0.15) -> BoardTrack:
    return track_board(scene.frame_stamps, scene.detections(sigma_px), scene.camera, BOARD.points)


def fit(scene: Moving) -> ImuCameraFit:
    return fit_imu_camera(track(scene), make_recording(scene.imu_stamps, scene.imu_values), NOISE)


def errors(found: ImuCameraFit, scene: Moving) -> tuple[np.ndarray, np.ndarray, float]:
    rotation = so3_log(found.T_cam_imu[:3, :3] @ scene.T_cam_imu[:3, :3].T)
    return rotation, found.T_cam_imu[:3, 3] - scene.T_cam_imu[:3, 3], found.timeshift_s - scene.timeshift_s


@pytest.fixture(scope="module")
def scene() -> Moving:
    return moving(seed=4, frame_hz=10.0)


@pytest.fixture(scope="module")
def found(scene: Moving) -> ImuCameraFit:
    return fit(scene)


def test_twelve_seconds_give_a_tenth_of_a_degree_half_a_millimetre_and_a_third_of_a_millisecond(found, scene) -> None:
    rotation, translation, timeshift = errors(found, scene)
    assert np.rad2deg(np.linalg.norm(rotation)) < 0.1
    assert np.linalg.norm(translation) < 0.5e-3
    assert abs(timeshift) < 0.3e-3


def test_the_truth_is_not_far_outside_the_intervals_and_they_are_narrow(found, scene) -> None:
    rotation, translation, timeshift = errors(found, scene)
    assert (np.abs(rotation) < 2 * found.rotation_half_width).all()
    assert (np.abs(translation) < 2 * found.translation_half_width).all()
    assert abs(timeshift) < 2 * found.timeshift_half_width_s
    assert found.consistency == pytest.approx(1.0, abs=0.1)
    assert verdict(found)[0] is Verdict.GOOD


def test_residuals_stay_within_the_noise_which_the_solution_follows_in_part(found) -> None:
    # White noise averaged over a tenth of a second.
    gyro, accel = (density / np.sqrt(0.1) for density in (NOISE.gyroscope_noise_density, NOISE.accelerometer_noise_density))
    assert 0.1 * gyro < np.nanstd(found.gyro_residuals) < 1.1 * gyro
    assert 0.1 * accel < np.nanstd(found.accel_residuals) < 1.1 * accel


def test_gravity_is_found_as_the_accelerometer_measures_it() -> None:
    light = moving(seed=5, gravity=9.76, frame_hz=10.0)
    assert fit(light).gravity == pytest.approx(9.76, abs=0.01)


def test_a_rotation_about_one_axis_only_is_told(scene) -> None:
    flat = moving(seed=6, axes=(0.02, 0.02, 1.0), frame_hz=10.0)
    level, sentence = verdict(fit(flat))
    assert level is not Verdict.GOOD
    assert "rotate more about the camera's x (to the right) and y (down)" in sentence


def test_angular_rates_alone_find_rotation_bias_and_a_large_time_offset() -> None:
    late = moving(seed=7, timeshift_s=-0.32)
    board = track(late)
    recording = make_recording(late.imu_stamps, late.imu_values)
    frame_s = (board.stamps_ns - recording.stamps_ns[0]) / 1e9
    found = align_rates(frame_s, board.T_cam_board[:, :3, :3], recording.seconds, recording.values[:, :3])
    assert found.timeshift_s == pytest.approx(-0.32, abs=1e-3)
    assert np.linalg.norm(so3_log(found.R_cam_imu @ late.T_cam_imu[:3, :3].T)) < np.deg2rad(0.5)
    assert found.correlation > 0.99


def test_a_frame_whose_corners_are_numbered_from_the_other_end_is_left_out(scene) -> None:
    detections = scene.detections()
    whole = next(index for index in range(30, 90) if len(detections[index]) == 54)
    detections[whole] = Detection(detections[whole].ids, detections[whole].pixels[::-1])
    board = track_board(scene.frame_stamps, detections, scene.camera, BOARD.points)
    assert len(board) == len(scene.frame_stamps) - 1
    assert scene.frame_stamps[whole] not in board.stamps_ns


def test_a_board_that_looks_the_same_from_both_ends_keeps_its_end(scene) -> None:
    detections = scene.detections()
    turn = pose(np.diag([-1.0, -1.0, 1.0]), BOARD.points[0] + BOARD.points[-1])
    turned = [Detection(53 - d.ids[::-1], d.pixels[::-1]) if index % 3 == 1 else d for index, d in enumerate(detections)]
    expected = track(scene).T_cam_board
    assert track_board(scene.frame_stamps, turned, scene.camera, BOARD.points, turn).T_cam_board == pytest.approx(
        expected, abs=1e-6
    )


def test_the_information_of_a_pose_is_that_of_its_corners(scene) -> None:
    rng = np.random.default_rng(0)
    board = track(scene).select(np.arange(len(scene.frame_stamps)) == 0)
    step = 1e-4 * rng.standard_normal(6)
    moved = board.T_cam_board[0] @ gtsam.Pose3.Expmap(step).matrix()
    before, after = (board.residuals_px(scene.camera, BOARD.points, T[None])[0] for T in (board.T_cam_board[0], moved))
    assert np.linalg.norm(board.roots[0] @ step) == pytest.approx(np.linalg.norm(after - before) / board.sigma_px, rel=1e-2)


def test_preintegration_follows_a_fast_turn(scene) -> None:
    # Without noise, GTSAM's way of turning the force leaves an error a hundred times as large.
    times = np.arange(0, 0.5, 0.005)
    rate = np.array([0.0, 0.0, 4.0])
    force = np.stack([np.cos(4 * times), -np.sin(4 * times), np.full_like(times, 9.81)], axis=1)
    recording = make_recording(np.rint(times * 1e9).astype(np.int64), np.hstack([np.tile(rate, (len(times), 1)), force]))
    intervals = ImuIntervals(recording, NOISE)
    measured = intervals.preintegrate(0.0012, 0.4012, np.zeros(6), intervals.params(9.81))
    # The force is constant in the world: 1 m/s² along what is x at time zero.
    start = np.array([np.cos(4 * 0.0012), -np.sin(4 * 0.0012)])
    assert measured.deltaVij()[:2] == pytest.approx(0.4 * start, abs=2e-4)


def test_too_few_frames_are_refused(scene) -> None:
    few = track(scene).select(np.arange(len(scene.frame_stamps)) < 20)
    with pytest.raises(InputError, match="the board was found in '20' frames, expected at least 40"):
        fit_imu_camera(few, make_recording(scene.imu_stamps, scene.imu_values), NOISE)


def test_recordings_of_different_times_are_refused(scene) -> None:
    with pytest.raises(InputError, match="share no time"):
        fit_imu_camera(track(scene), make_recording(scene.imu_stamps + 3_600 * 10**9, scene.imu_values), NOISE)


def test_a_camera_at_rest_is_refused() -> None:
    still = moving(seed=8, axes=(0.01, 0.01, 0.01))
    with pytest.raises(InputError, match=r"the camera turns by only '.*' °/s"):
        fit(still)


def test_another_sensors_imu_is_refused(scene) -> None:
    other = replace(scene, imu_values=moving(seed=99).imu_values[: len(scene.imu_stamps)])
    with pytest.raises(InputError, match="angular rates of camera and gyroscope correlate by"):
        fit(other)


@pytest.mark.slow
def test_ten_sensors_are_calibrated_and_nine_in_ten_truths_lie_in_their_intervals() -> None:
    inside = []
    for seed in range(10):
        scene = moving(seed, duration_s=30.0)
        found = fit(scene)
        rotation, translation, timeshift = errors(found, scene)
        assert np.rad2deg(np.linalg.norm(rotation)) <= 0.1
        assert np.linalg.norm(translation) <= 0.5e-3
        assert abs(timeshift) <= 0.3e-3
        inside += (np.abs(rotation) < found.rotation_half_width).tolist()
        inside += (np.abs(translation) < found.translation_half_width).tolist()
        inside.append(abs(timeshift) < found.timeshift_half_width_s)
    assert np.mean(inside) > 0.85
