"""The camera–IMU time shift, found from rotations."""

from __future__ import annotations

import numpy as np
import pytest

from vli_common.arrays import FloatArray, IntArray
from vli_common.geometry import so3_exp
from vli_frontend.config import TimeShiftConfig
from vli_frontend.synchroniser import ImuSegment
from vli_frontend.time_shift import TimeShiftMonitor

FRAME_S, SECOND = 1.0 / 30.0, 1_000_000_000
BIAS = np.array([0.006, -0.004, 0.002])


def _attitude(t: float, amplitude: float) -> FloatArray:
    return amplitude * np.array([np.sin(21 * t), np.cos(17 * t), np.sin(13 * t + 1)])


def _rate(t: float, amplitude: float) -> FloatArray:
    """Return the angular rate by differences."""
    before, after = so3_exp(_attitude(t - 1e-4, amplitude)), so3_exp(_attitude(t + 1e-4, amplitude))
    turn = before.T @ after
    return np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 4e-4


def _segment(begin_s: float, end_s: float, amplitude: float) -> ImuSegment:
    times = np.linspace(begin_s, end_s, 8)
    stamps: IntArray = np.round(times * SECOND).astype(np.int64)
    gyro = np.stack([_rate(t, amplitude) for t in times]) + BIAS
    return ImuSegment(stamps, gyro, np.zeros_like(gyro), np.full(len(stamps) - 1, 5_000_000))


def _watch(
    error_s: float, seconds: float = 8.0, amplitude: float = 0.01, noise: float = 1e-4, monitor: TimeShiftMonitor | None = None
) -> TimeShiftMonitor:
    """Return a monitor that saw frames whose IMU is taken ``error_s`` too early."""
    monitor, rng = monitor or TimeShiftMonitor(TimeShiftConfig()), np.random.default_rng(0)
    for k in range(int(seconds / FRAME_S)):
        t = 1.0 + k * FRAME_S
        stamp = round(t * SECOND)
        begin = monitor.previous_ns(stamp)
        segment = None if begin is None else _segment(begin * 1e-9 - error_s, t - error_s, amplitude)
        monitor.add(stamp, so3_exp(_attitude(t, amplitude)) @ so3_exp(noise * rng.normal(size=3)), segment)
    return monitor


@pytest.mark.parametrize("error_s", [0.008, -0.008, 0.015])
def test_a_wrong_shift_is_found_within_a_millisecond(error_s: float) -> None:
    assert _watch(error_s).correction_s() == pytest.approx(error_s, abs=1e-3)


def test_a_right_shift_is_left_alone() -> None:
    monitor = _watch(0.0)
    found = monitor.estimate()
    assert found is not None
    assert abs(found.error_s) < 3.0 * found.sigma_s
    assert monitor.correction_s() == 0.0


def test_a_scanner_that_hardly_turns_tells_nothing() -> None:
    assert _watch(0.008, amplitude=1e-5).estimate() is None


def test_noise_that_hides_the_shift_corrects_nothing() -> None:
    assert _watch(0.002, noise=2e-3, amplitude=0.004).correction_s() == 0.0


def test_frames_far_apart_are_not_compared() -> None:
    monitor = TimeShiftMonitor(TimeShiftConfig())
    monitor.add(SECOND, np.eye(3), None)
    assert monitor.previous_ns(SECOND + 33_000_000) == SECOND
    assert monitor.previous_ns(2 * SECOND) is None
    assert monitor.previous_ns(SECOND) is None


def test_a_reset_forgets_everything() -> None:
    monitor = _watch(0.008)
    monitor.reset()
    assert monitor.estimate() is None
    assert monitor.correction_s() == 0.0


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_poses_that_lean_on_the_gyroscope_hide_a_part_that_is_found_all_the_same(share: float) -> None:
    monitor, left_s = TimeShiftMonitor(TimeShiftConfig()), 0.008
    for _ in range(4):
        _watch(share * left_s, 4.0, monitor=monitor)
        left_s -= monitor.correction_s()
        monitor.reset()
    assert abs(left_s) < 1e-3
