"""Where a recording is at rest: nothing but its own noise tells what is motion."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from vli_calibration.imu_recording import ImuRecording
from vli_common.arrays import BoolArray, FloatArray
from vli_common.errors import InputError

BLOCK_S = 0.5
_OUTLYING = 8.0
"""Robust standard deviations from which on a change of a block's mean is motion: never by chance, even in days."""
_SHAKING = 3.0
"""Times the usual scatter within a block."""
_SLOW_BLOCKS = 20
_MARGIN_BLOCKS = 2
_LONGEST_FILLED_S = 0.1
_STEADY_RATE, _STEADY_FORCE = 0.02, 0.3
"""rad/s and m/s²: more than the means of blocks of any sensor at rest change, less than those of a hand-held one."""
_GRAVITY_RANGE = (8.8, 10.8)
_UNITS = ("rad/s",) * 3 + ("m/s²",) * 3
CHANNELS = ("gyro x", "gyro y", "gyro z", "accel x", "accel y", "accel z")


@dataclass(frozen=True)
class StillStretch:
    """The longest stretch of a recording without motion and without long gaps, resampled without its short gaps.

    Args:
        values: (N, 6) evenly spaced samples.
        period_s: their spacing.
        start_s, end_s: within the recording.
        motion_s: (start, end) of what was taken for motion, seconds since the start of the recording.
        filled: samples interpolated across gaps of at most 0.1 s.
    """

    values: FloatArray
    period_s: float
    start_s: float
    end_s: float
    motion_s: list[tuple[float, float]]
    filled: int

    @property
    def duration_s(self) -> float:
        """Seconds."""
        return self.end_s - self.start_s

    def block_means(self, block_s: float = BLOCK_S) -> tuple[FloatArray, float]:
        """Return averages (M, 6) over consecutive blocks, and the exact length of a block in seconds."""
        size = max(1, round(block_s / self.period_s))
        return _blocks(self.values, size).mean(axis=1), size * self.period_s


def longest_still_stretch(recording: ImuRecording, shortest_s: float) -> StillStretch:
    """Return the longest stretch at rest.

    Raises:
        InputError: none is as long as ``shortest_s``; the sensor moves throughout, is stuck, or not in SI units.
    """
    total_s = float(recording.seconds[-1])
    if total_s < shortest_s:
        raise InputError(
            f"the IMU was recorded for '{total_s:.1f}' s, expected at least {shortest_s:g} s at rest: hours are good"
        )
    _check_values(recording)
    pieces = _between_gaps(recording)
    candidates, motion_s = list[tuple[int, int]](), list[tuple[float, float]]()
    for first, last in pieces:
        still, moving = _still_runs(recording, first, last)
        candidates += still
        motion_s += moving
    seconds = recording.seconds
    first, last = max(candidates, key=lambda run: seconds[run[1] - 1] - seconds[run[0]], default=(0, 1))
    length_s = float(seconds[last - 1] - seconds[first])
    if length_s < shortest_s:
        raise InputError(_too_short(recording, length_s, shortest_s, motion_s))
    values, filled = _evenly(recording, first, last)
    return StillStretch(values, recording.period_s, float(seconds[first]), float(seconds[last - 1]), motion_s, filled)


def _check_values(recording: ImuRecording) -> None:
    if stuck := [CHANNELS[index] for index in np.flatnonzero(np.ptp(recording.values, axis=0) == 0)]:
        raise InputError(f"'{', '.join(stuck)}' never changes: no noise to measure; check the IMU's driver and record again")
    force = float(np.linalg.norm(np.median(recording.values[:, 3:], axis=0)))
    if not _GRAVITY_RANGE[0] < force < _GRAVITY_RANGE[1]:
        raise InputError(
            f"the accelerometer reads '{force:.3g}' at rest, expected 9.8 m/s²; "
            "fix the unit (sensor_msgs/Imu: m/s² and rad/s) and record again"
        )


def _between_gaps(recording: ImuRecording) -> list[tuple[int, int]]:
    """Return ranges of rows [first, last) between gaps too long to fill."""
    steps_s = np.diff(recording.seconds)
    cuts = np.flatnonzero(steps_s > max(_LONGEST_FILLED_S, 3 * recording.period_s)) + 1
    bounds = [0, *cuts.tolist(), len(recording.stamps_ns)]
    return [(first, last) for first, last in itertools.pairwise(bounds) if last - first > 1]


def _still_runs(recording: ImuRecording, first: int, last: int) -> tuple[list[tuple[int, int]], list[tuple[float, float]]]:
    """Return the still ranges of rows within [first, last), and the spans of motion in seconds."""
    size = max(1, round(BLOCK_S / recording.period_s))
    blocks = _blocks(recording.values[first:last], size)
    if len(blocks) < 3 * _SLOW_BLOCKS:
        return [], []
    moving = _moving(blocks.mean(axis=1), blocks.std(axis=1))
    seconds = recording.seconds[first:last]
    edges = np.concatenate([seconds[: len(blocks) * size : size], [seconds[-1]]])
    motion = [(float(edges[start]), float(edges[end])) for start, end in _runs(moving)]
    still = [(first + start * size, first + end * size) for start, end in _runs(~_widened(moving))]
    return still, motion


def _moving(means: FloatArray, scatter: FloatArray) -> BoolArray:
    """Return which blocks (M,) are in motion, from their means and standard deviations (M, 6)."""
    shaking = (scatter > _SHAKING * np.maximum(np.median(scatter, axis=0), 1e-12)).any(axis=1)
    moving: BoolArray = np.logical_or(shaking, _jumps(means))
    # A slow push hides in the steps from block to block, not in those of longer averages of what seemed at rest.
    weights = _blocks((~_widened(moving)).astype(np.float64)[:, None], _SLOW_BLOCKS)
    count = weights.sum(axis=1)
    slow = (_blocks(means, _SLOW_BLOCKS) * weights).sum(axis=1) / np.maximum(count, 1)
    known = np.flatnonzero(count[:, 0] >= _SLOW_BLOCKS / 2)
    jumped = np.zeros(len(slow), dtype=bool)
    jumped[known] = _jumps(slow[known])
    moving[: len(slow) * _SLOW_BLOCKS] |= np.repeat(jumped, _SLOW_BLOCKS)
    return moving


def _jumps(means: FloatArray) -> BoolArray:
    """Return which of M averages (M, 6) differ from a neighbour by more than noise does."""
    if len(means) < 2:
        return np.zeros(len(means), dtype=bool)
    steps = np.diff(means, axis=0)
    scale = 1.4826 * np.median(np.abs(steps - np.median(steps, axis=0)), axis=0)
    limit = np.repeat([_STEADY_RATE, _STEADY_FORCE], 3)
    jump = (np.abs(steps) > np.minimum(_OUTLYING * np.maximum(scale, 1e-12), limit)).any(axis=1)
    result: BoolArray = np.concatenate([[False], jump]) | np.concatenate([jump, [False]])
    return result


def _widened(moving: BoolArray) -> BoolArray:
    kernel = np.ones(2 * _MARGIN_BLOCKS + 1)
    result: BoolArray = np.convolve(moving, kernel, mode="same") > 0.5
    return result


def _runs(flags: BoolArray) -> list[tuple[int, int]]:
    steps = np.diff(np.concatenate([[0], flags.astype(np.int8), [0]]))
    return list(zip(np.flatnonzero(steps == 1).tolist(), np.flatnonzero(steps == -1).tolist(), strict=True))


def _blocks(values: FloatArray, size: int) -> FloatArray:
    """Return (M, size, channels) whole blocks."""
    count = len(values) // size
    return values[: count * size].reshape(count, size, values.shape[1])


def _evenly(recording: ImuRecording, first: int, last: int) -> tuple[FloatArray, int]:
    """Return the samples with the missing ones interpolated, and their number."""
    values = recording.values[first:last]
    steps = np.maximum(1, np.rint(np.diff(recording.seconds[first:last]) / recording.period_s)).astype(np.int64)
    places = np.concatenate([[0], np.cumsum(steps)])
    missing = int(places[-1]) + 1 - len(values)
    if missing == 0:
        return values, 0
    grid = np.arange(places[-1] + 1)
    return np.stack([np.interp(grid, places, column) for column in values.T], axis=1), missing


def _too_short(recording: ImuRecording, length_s: float, shortest_s: float, motion_s: list[tuple[float, float]]) -> str:
    cause = "gaps in the stamps"
    if motion_s:
        named = ", ".join(f"{start:.1f}–{end:.1f} s" for start, end in motion_s[:3])
        cause = f"motion at {named}" + (f" and {len(motion_s) - 3} times more" if len(motion_s) > 3 else "")
    elif gaps := sorted(recording.gaps(), key=lambda gap: -gap[1])[:3]:
        cause = "gaps of " + ", ".join(f"{length:.2f} s at {start:.1f} s" for start, length in gaps)
    return (
        f"the longest stretch at rest is '{length_s:.1f}' s, expected at least {shortest_s:g} s ({cause}); "
        "put the sensor down on something that does not shake, for hours if you can, and record again"
    )
