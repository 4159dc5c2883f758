"""The state machine: outages short and long, the place of a new window, relocalisation, failures of the solver."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from scene import Motion, Scan, calibration

from vli_backend.backend import BackEnd
from vli_backend.config import BackEndConfig
from vli_backend.smoother import GtsamSmoother, SmootherError
from vli_common.geometry import inverse, pose, so3_exp
from vli_common.types import BackEndOutput, FrontEndOutput, LaserScan, MapConstraints, Mode, Relocalisation, TrackingState

Change = Callable[[FrontEndOutput, float], FrontEndOutput | None]


def _without_tracks(frame: FrontEndOutput) -> FrontEndOutput:
    names = ("ids", "pixels", "rays", "velocity", "sigma_px", "stripe_px", "flags")
    nothing = {name: getattr(frame.tracks, name)[:0] for name in names}
    return dataclasses.replace(frame, tracks=dataclasses.replace(frame.tracks, **nothing))


def _covered(begin_s: float, end_s: float) -> Change:
    return lambda frame, t: _without_tracks(frame) if begin_s < t < end_s else frame


def _run(change: Change, duration_s: float, scan: Scan | None = None, laser: bool = True) -> tuple[BackEnd, list[BackEndOutput]]:
    back_end, scan = BackEnd(calibration(), BackEndConfig(), Mode.VLI_ODOM), scan or Scan()
    outputs = []
    for item in scan.frames(duration_s):
        if isinstance(item, LaserScan):
            if laser or item.stamp_ns < 3_000_000_000:
                back_end.add_scan(item)
            continue
        frame = change(item, item.tracks.stamp_ns * 1e-9 - 1.0)
        if frame is not None:
            outputs.append(back_end.add_frame(frame))
            if (bias := outputs[-1].bias) is not None:
                scan.bias = bias
    return back_end, outputs


def _states(outputs: list[BackEndOutput], begin_s: float, end_s: float) -> set[TrackingState]:
    return {o.state for o in outputs if begin_s < o.stamp_ns * 1e-9 - 1.0 < end_s}


def test_a_short_outage_is_carried_by_the_imu() -> None:
    scan = Scan()
    back_end, outputs = _run(_covered(3.0, 3.6), 6.0, scan)
    assert _states(outputs, 3.1, 3.55) == {TrackingState.DEGRADED}
    assert "the IMU carries it" in next(o.reason for o in outputs if o.state is TrackingState.DEGRADED)
    assert outputs[-1].state is TrackingState.TRACKING
    assert back_end.counters["lost"] == 0
    first, last = (next(o for o in outputs if o.stamp_ns * 1e-9 - 1.0 > t and o.pose is not None) for t in (2.9, 4.2))
    assert first.pose is not None
    assert last.pose is not None
    T_imu_cam = inverse(calibration().T_cam_imu)
    moved = inverse(first.pose.T_map_imu @ T_imu_cam) @ last.pose.T_map_imu @ T_imu_cam
    true = inverse(scan.truth(first.stamp_ns)) @ scan.truth(last.stamp_ns)
    assert np.linalg.norm(moved[:3, 3] - true[:3, 3]) < 3e-3


def test_a_camera_that_is_gone_counts_like_a_covered_one() -> None:
    back_end, outputs = _run(lambda frame, t: None if 3.0 < t < 5.0 else frame, 5.2)
    assert back_end.counters["lost"] <= 1
    gap = next(k for k, o in enumerate(outputs) if o.stamp_ns * 1e-9 - 1.0 >= 5.0)
    assert outputs[gap - 1].state is TrackingState.TRACKING


def test_after_a_long_outage_it_starts_again_where_the_imu_carried_it() -> None:
    scan = Scan()
    back_end, outputs = _run(_covered(3.0, 6.0), 8.0, scan)
    lost = [o for o in outputs if o.state is TrackingState.LOST]
    assert lost
    assert all(o.pose is None for o in lost)
    assert all("covered lens" in o.reason for o in lost)
    assert any("a new start: only 0 features" in o.reason for o in lost)
    again = next(o for o in outputs if o.stamp_ns * 1e-9 - 1.0 > 6.0 and o.state is TrackingState.TRACKING)
    assert again.stamp_ns * 1e-9 - 1.0 < 7.5
    assert back_end.counters["starts"] == 2
    assert not back_end.is_located
    assert "guess" in outputs[-1].reason
    assert again.pose is not None
    T_imu_cam = inverse(calibration().T_cam_imu)
    before = next(o for o in reversed(outputs) if o.stamp_ns * 1e-9 - 1.0 < 3.0 and o.pose is not None)
    assert before.pose is not None
    moved = inverse(before.pose.T_map_imu @ T_imu_cam) @ again.pose.T_map_imu @ T_imu_cam
    true = inverse(scan.truth(before.stamp_ns)) @ scan.truth(again.stamp_ns)
    sigma = np.sqrt(again.pose.covariance[0, 0])
    assert np.linalg.norm(moved[:3, 3] - true[:3, 3]) < 3.0 * sigma
    angle = np.arccos(np.clip((np.trace(moved[:3, :3].T @ true[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
    assert angle < 0.02


def test_a_relocalisation_moves_everything_into_the_map_from_then_on() -> None:
    scan, T = Scan(), pose(so3_exp(np.array([0.0, 0.0, 0.7])), np.array([0.1, -0.2, 0.05]))
    back_end = BackEnd(calibration(), BackEndConfig(), Mode.VLI_SLAM)
    reference, window_ns = BackEnd(calibration(), BackEndConfig(), Mode.VLI_SLAM), 0
    for item in scan.frames(3.0):
        if isinstance(item, LaserScan):
            back_end.add_scan(item)
            reference.add_scan(item)
            continue
        if item.tracks.stamp_ns > 2_500_000_000 and back_end.counters["relocalisations"] == 0:
            back_end.relocalise(Relocalisation(window_ns, T, 1e-3))
        moved, plain = back_end.add_frame(item), reference.add_frame(item)
        expected = T if back_end.counters["relocalisations"] else np.eye(4)
        if plain.pose is not None and moved.pose is not None:
            np.testing.assert_allclose(moved.pose.T_map_imu, expected @ plain.pose.T_map_imu, atol=1e-9)
            np.testing.assert_allclose(
                inverse(moved.pose.T_map_odom) @ moved.pose.T_map_imu,
                inverse(plain.pose.T_map_odom) @ plain.pose.T_map_imu,
                atol=1e-9,
            )
        if plain.window is not None and moved.window is not None:
            np.testing.assert_allclose(moved.window.T_map_camera, expected @ plain.window.T_map_camera, atol=1e-9)
            assert moved.window.placement == back_end.counters["relocalisations"]
            window_ns = moved.window.stamp_ns
    assert back_end.is_located
    back_end.relocalise(Relocalisation(window_ns, T, 1e-3, session=5))
    assert back_end.counters["relocalisations_of_other_sessions"] == 1


def test_a_relocalisation_of_a_window_that_has_moved_since_is_dropped() -> None:
    back_end, stamps = BackEnd(calibration(), BackEndConfig(), Mode.VLI_SLAM), []
    for item in Scan().frames(2.5):
        if isinstance(item, LaserScan):
            back_end.add_scan(item)
        elif (window := back_end.add_frame(item).window) is not None:
            stamps.append(window.stamp_ns)
    back_end.relocalise(Relocalisation(stamps[-1], np.eye(4), 1e-3))
    for stamp_ns in (stamps[-2], stamps[-1], stamps[-1] + 1):
        back_end.relocalise(Relocalisation(stamp_ns, np.eye(4), 1e-3))
    assert back_end.counters["relocalisations"] == 1
    assert back_end.counters["relocalisations_late"] == 3


def test_constraints_found_before_a_relocalisation_are_dropped() -> None:
    back_end, window_ns = BackEnd(calibration(), BackEndConfig(), Mode.VLI_SLAM), 0
    for item in Scan().frames(2.5):
        if isinstance(item, LaserScan):
            back_end.add_scan(item)
        elif (window := back_end.add_frame(item).window) is not None:
            window_ns = window.stamp_ns
    none = np.empty(0)
    constraints = MapConstraints(window_ns, none.astype(np.int64), *(np.empty((0, 3)) for _ in range(3)), none, none)
    back_end.relocalise(Relocalisation(window_ns, np.eye(4), 1e-3))
    back_end.add_constraints(constraints)
    assert back_end.counters["map_constraints_before_relocalisation"] == 1


def test_a_missing_laser_is_said_while_tracking_goes_on() -> None:
    _, outputs = _run(lambda frame, t: frame, 5.5, laser=False)
    assert outputs[-1].state is TrackingState.TRACKING
    assert "no laser for" in outputs[-1].reason


def test_a_missing_imu_is_said_while_tracking_goes_on() -> None:
    _, outputs = _run(lambda f, t: dataclasses.replace(f, preintegration=None) if t > 2.0 else f, 5.0)
    assert outputs[-1].state is TrackingState.TRACKING
    assert "no IMU for" in outputs[-1].reason


def test_a_start_without_imu_samples_says_so() -> None:
    _, outputs = _run(lambda f, t: dataclasses.replace(f, preintegration=None), 1.0)
    assert outputs[-1].state is TrackingState.INITIALISING
    assert "no IMU samples" in outputs[-1].reason


def test_a_start_with_few_features_says_so() -> None:
    _, outputs = _run(lambda f, t: _without_tracks(f), 0.5)
    assert outputs[-1].state is TrackingState.INITIALISING
    assert "only 0 features" in outputs[-1].reason


@pytest.mark.parametrize(("failures", "counts"), [(1, (1, 0, 0)), (2, (0, 1, 0)), (4, (0, 2, 1))])
def test_a_solver_that_fails_is_tried_again_then_costs_the_window_but_not_the_scan(
    failures: int, counts: tuple[int, int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    solve, left = GtsamSmoother.solve, [failures]

    def fail(smoother: GtsamSmoother, condenser: object, iterations: int) -> int:
        if left[0] and np.linalg.norm(smoother.states()[-1].T_map_imu[:3, 3]) > 0.02:
            left[0] -= 1
            raise SmootherError("indeterminate linear system")
        return solve(smoother, condenser, iterations)  # type: ignore[arg-type]

    monkeypatch.setattr(GtsamSmoother, "solve", fail)
    back_end, outputs = _run(lambda frame, t: frame, 6.0, Scan(Motion(rest_s=0.5)))
    assert tuple(back_end.counters[name] for name in ("solver_rescues", "solver_failures", "lost")) == counts
    assert outputs[-1].state is TrackingState.TRACKING
    assert any("indeterminate linear system" in o.reason for o in outputs)


@pytest.mark.slow
def test_a_scanner_at_rest_does_not_drift() -> None:
    _, outputs = _run(lambda frame, t: frame, 24.0, Scan(Motion(rest_s=1e6), pixel_noise=0.2))
    positions = np.stack([o.pose.T_map_imu[:3, 3] for o in outputs if o.pose is not None])
    end = positions[-60:].mean(axis=0) - positions[:60].mean(axis=0)
    assert np.linalg.norm(end) < 1e-5
