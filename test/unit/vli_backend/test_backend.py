"""The back end on a synthetic scan: starts, accuracy, losses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scene import SHORT_NS, Motion, Scan, calibration

from vli_backend.backend import BackEnd
from vli_backend.config import BackEndConfig
from vli_backend.depth_prior import DepthPrior
from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration
from vli_common.geometry import align, inverse, transform
from vli_common.types import BackEndOutput, LaserScan, Mode, TrackingState


def _run(
    scan: Scan, duration_s: float, mode: Mode = Mode.VLI_ODOM, cal: Calibration | None = None
) -> tuple[BackEnd, list[BackEndOutput]]:
    back_end = BackEnd(cal or calibration(), BackEndConfig(), mode)
    outputs = []
    for item in scan.frames(duration_s):
        if isinstance(item, LaserScan):
            back_end.add_scan(item)
        else:
            outputs.append(back_end.add_frame(item))
            if (bias := outputs[-1].bias) is not None:
                scan.bias = bias
    return back_end, outputs


def _trajectory(outputs: list[BackEndOutput], cal: Calibration) -> tuple[list[int], FloatArray]:
    posed = [o for o in outputs if o.pose is not None]
    T_imu_cam = inverse(cal.T_cam_imu) if cal.T_cam_imu is not None else np.eye(4)
    return [o.stamp_ns for o in posed], np.stack([o.pose.T_map_imu @ T_imu_cam for o in posed if o.pose is not None])


def _errors(scan: Scan, outputs: list[BackEndOutput], cal: Calibration) -> tuple[float, float]:
    """Return translation RMSE in mm after SE(3) alignment, and the scale error in percent."""
    stamps, poses = _trajectory(outputs, cal)
    truth = np.stack([scan.truth(s) for s in stamps])
    T, _ = align(poses[:, :3, 3], truth[:, :3, 3])
    _, scale = align(poses[:, :3, 3], truth[:, :3, 3], with_scale=True)
    errors = np.linalg.norm(transform(T, poses[:, :3, 3]) - truth[:, :3, 3], axis=1)
    return float(np.sqrt((errors**2).mean()) * 1e3), abs(1 / scale - 1) * 100


def test_a_start_at_rest_tracks_to_a_tenth_of_a_millimetre() -> None:
    scan = Scan()
    back_end, outputs = _run(scan, 7.0)
    rmse, scale = _errors(scan, outputs, calibration())
    assert rmse < 0.1
    assert scale < 0.2
    tracked = [o.stamp_ns for o in outputs if o.state is TrackingState.TRACKING]
    assert tracked[0] - outputs[0].stamp_ns < 0.6e9
    assert len(tracked) == len([o for o in outputs if o.stamp_ns >= tracked[0]])
    assert back_end.counters["starts"] == 1


def test_the_map_is_gravity_aligned() -> None:
    scan = Scan(accel_bias=np.zeros(3))
    _, outputs = _run(scan, 3.0)
    stamps, poses = _trajectory(outputs, calibration())
    for stamp, T in zip(stamps, poses, strict=True):
        down_true, down = scan.truth(stamp)[:3, :3].T @ [0, 0, 1.0], T[:3, :3].T @ [0, 0, 1.0]
        assert np.arccos(min(1.0, down_true @ down)) < 5e-3


@pytest.mark.parametrize("start_s", [0.0, 1.3, 2.9])
def test_a_start_in_motion_tracks_within_a_second_and_a_half(start_s: float) -> None:
    scan = Scan(Motion(rest_s=0.0), start_s=start_s, seed=int(start_s * 10))
    _, outputs = _run(scan, 5.0)
    first = next(o for o in outputs if o.state is TrackingState.TRACKING)
    assert first.stamp_ns - outputs[0].stamp_ns < 1.5e9
    rmse, scale = _errors(scan, outputs, calibration())
    assert rmse < 0.03
    assert scale < 0.3


@pytest.mark.parametrize(("start_s", "speed"), [(0.0, 0.008), (0.4, 0.014), (0.8, 0.008), (2.4, 0.014)])
def test_the_first_window_of_a_start_in_motion_knows_its_scale_and_has_all_frames(start_s: float, speed: float) -> None:
    scan = Scan(Motion(rest_s=0.0, speed=speed), start_s=start_s, seed=int(start_s * 10))
    _, outputs = _run(scan, 3.0)
    window = next(o.window for o in outputs if o.window is not None)
    truth = np.stack([scan.truth(stamp) for stamp in window.stamps])
    _, scale = align(window.T_map_camera[:, :3, 3], truth[:, :3, 3], with_scale=True)
    assert abs(1 / scale - 1) < 0.008
    assert np.diff(window.stamps).max() < 1.1 * SHORT_NS


@pytest.mark.parametrize("guess_m", [0.028, 0.044])
def test_a_first_guess_of_depths_that_is_a_quarter_off_does_not_hold_the_scale(
    monkeypatch: pytest.MonkeyPatch, guess_m: float
) -> None:
    """As where the stripe lies between the keys at rest, and the features on top of them."""
    monkeypatch.setattr(DepthPrior, "guess", lambda *_: 1.0 / guess_m)
    scan = Scan(seed=3)
    _, outputs = _run(scan, 2.5)
    stamps, poses = _trajectory(outputs, calibration())
    truth = np.stack([scan.truth(stamp) for stamp in stamps])
    shift, true_shift = ((inverse(T[0]) @ T)[:, :3, 3] for T in (poses, truth))
    assert np.linalg.norm(shift - true_shift, axis=1).max() < 2e-4


def test_without_an_imu_a_window_that_begins_in_motion_begins_where_the_scanner_is() -> None:
    scan = Scan(Motion(rest_s=0.0), with_imu=False)
    cal = dataclasses.replace(calibration(), T_cam_imu=None, imu=None)
    _, outputs = _run(scan, 1.0, Mode.VL, cal)
    stamps, poses = _trajectory(outputs, cal)
    truth = np.stack([scan.truth(stamp) for stamp in stamps[:2]])
    step, true_step = (np.linalg.norm(T[1, :3, 3] - T[0, :3, 3]) for T in (poses, truth))
    assert step == pytest.approx(true_step, rel=0.15)


def test_the_scanner_works_without_an_imu() -> None:
    scan = Scan(with_imu=False)
    cal = dataclasses.replace(calibration(), T_cam_imu=None, imu=None)
    _, outputs = _run(scan, 6.0, Mode.VL, cal)
    rmse, scale = _errors(scan, outputs, cal)
    assert rmse < 0.3
    assert scale < 1.0


def test_without_the_laser_the_imu_gives_the_scale_once_the_motion_tells_it() -> None:
    scan = Scan(Motion(tremor=4.0), pixel_noise=0.05)
    _, outputs = _run(scan, 8.0, Mode.VI)
    rmse, scale = _errors(scan, outputs, calibration())
    assert rmse < 2.0
    assert scale < 6.0
    first = next(o for o in outputs if o.state is TrackingState.TRACKING)
    assert "scale known to" in first.reason


def test_without_the_laser_an_even_motion_does_not_start_and_says_why() -> None:
    _, outputs = _run(Scan(Motion(tremor=0.0)), 4.0, Mode.VI)
    assert all(o.pose is None for o in outputs)
    assert "scale" in outputs[-1].reason
    assert "move less evenly" in outputs[-1].reason


def test_window_frames_turn_final_exactly_once_and_in_order() -> None:
    back_end, outputs = _run(Scan(), 5.0)
    final: list[int] = []
    windows = [o.window for o in outputs if o.window is not None] + [back_end.flush()]
    for window in windows:
        assert window is not None
        final += [int(s) for s in window.stamps[window.final]]
    assert final == sorted(set(final))
    posed = {o.stamp_ns for o in outputs if o.pose is not None}
    assert posed <= set(final)


def test_the_published_bias_is_the_true_one() -> None:
    scan = Scan(Motion(tremor=2.0))
    _, outputs = _run(scan, 6.0)
    bias = next(o.bias for o in reversed(outputs) if o.bias is not None)
    np.testing.assert_allclose(bias.gyro, scan.gyro_bias, atol=5e-4)


def test_a_blind_camera_is_degraded_then_lost_and_starts_again() -> None:
    scan = Scan()
    back_end = BackEnd(calibration(), BackEndConfig(), Mode.VLI_ODOM)
    states = []
    for item in scan.frames(8.0):
        if isinstance(item, LaserScan):
            back_end.add_scan(item)
            continue
        t = (item.tracks.stamp_ns - 1_000_000_000) * 1e-9
        if 3.0 < t < 5.0:
            none = np.zeros(len(item.tracks), np.bool_)
            empty = {
                name: getattr(item.tracks, name)[none]
                for name in ("ids", "pixels", "rays", "velocity", "sigma_px", "stripe_px", "flags")
            }
            item = dataclasses.replace(item, tracks=dataclasses.replace(item.tracks, **empty))
        output = back_end.add_frame(item)
        states.append((t, output.state))
        assert (output.pose is not None) == output.state.has_pose
    during = [s for t, s in states if 3.1 < t < 5.0]
    assert during[0] is TrackingState.DEGRADED
    assert TrackingState.LOST in during
    assert states[-1][1] is TrackingState.TRACKING
    assert back_end.counters["lost"] == 1


def test_without_a_stripe_it_says_so() -> None:
    back_end = BackEnd(calibration(), BackEndConfig(), Mode.VLI_ODOM)
    outputs = [back_end.add_frame(item) for item in Scan().frames(1.0) if not isinstance(item, LaserScan)]
    assert outputs[-1].state is TrackingState.INITIALISING
    assert "no laser stripe" in outputs[-1].reason


def test_products_of_another_session_are_dropped_and_counted() -> None:
    back_end = BackEnd(calibration(), BackEndConfig(), Mode.VLI_ODOM)
    back_end.reset(1, "clock jumped")
    for item in Scan().frames(0.1):
        if isinstance(item, LaserScan):
            back_end.add_scan(item)
        else:
            back_end.add_frame(item)
    assert back_end.counters["frames_of_other_sessions"] == 3
    assert back_end.counters["scans_of_other_sessions"] == 3


def test_a_pause_of_the_imu_is_bridged_by_vision_and_laser() -> None:
    scan = Scan()
    back_end = BackEnd(calibration(), BackEndConfig(), Mode.VLI_ODOM)
    outputs = []
    for item in scan.frames(6.0):
        if isinstance(item, LaserScan):
            back_end.add_scan(item)
            continue
        if 3e9 < item.tracks.stamp_ns - 1_000_000_000 < 3.8e9:
            item = dataclasses.replace(item, preintegration=None)
        outputs.append(back_end.add_frame(item))
    assert all(o.state is TrackingState.TRACKING for o in outputs if o.stamp_ns > 2_000_000_000)
    assert _errors(scan, outputs, calibration())[0] < 0.2


def test_the_reported_covariance_is_finite_and_positive() -> None:
    _, outputs = _run(Scan(), 3.0)
    for output in outputs:
        if output.pose is not None:
            assert (np.linalg.eigvalsh(output.pose.covariance) > 0).all()


def test_the_odometry_frame_is_continuous_across_keyframes() -> None:
    _, outputs = _run(Scan(), 5.0)
    poses = [o.pose for o in outputs if o.pose is not None]
    odometry = np.stack([(inverse(p.T_map_odom) @ p.T_map_imu)[:3, 3] for p in poses])
    steps = np.linalg.norm(np.diff(odometry, axis=0), axis=1)
    assert steps.max() < 0.014 / 30 * 3


def test_features_that_are_nonsense_never_move_the_pose_out_of_reach() -> None:
    scan = Scan()
    back_end = BackEnd(calibration(), BackEndConfig(), Mode.VLI_ODOM)
    rng = np.random.default_rng(0)
    last: FloatArray | None = None
    for item in scan.frames(5.0):
        if isinstance(item, LaserScan):
            back_end.add_scan(item)
            continue
        if 3e9 < item.tracks.stamp_ns - 1_000_000_000 < 3.4e9:
            nonsense = rng.uniform(-0.7, 0.7, item.tracks.rays.shape)
            item = dataclasses.replace(item, tracks=dataclasses.replace(item.tracks, rays=nonsense))
        output = back_end.add_frame(item)
        if output.pose is not None:
            position = output.pose.T_map_imu[:3, 3]
            assert last is None or np.linalg.norm(position - last) < 0.02
            last = position
        else:
            last = None
