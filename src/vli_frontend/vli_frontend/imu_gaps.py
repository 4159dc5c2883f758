"""What a gap in the IMU costs: how far the line between its two ends is from what would have been measured.

A hand trembles at 4 to 12 Hz, so that even 50 ms without samples miss a good part of a turn. How large that part is, the samples
before the gap tell: the same line is drawn across every stretch of that length there, and compared with what was measured in it.
"""

from __future__ import annotations

import numpy as np

from vli_common.arrays import FloatArray, IntArray

HISTORY = 512
"""Samples before the gap that are looked at."""
HOLE = 1.5
"""An interval of so many periods is a gap."""
_LEAST_STRETCHES = 20
_UNKNOWN = np.array([0.1, 0.5])
"""rad/s and m/s²: what a hand adds to its steady motion, taken where there are too few samples to tell."""
_FEW = 2.0
"""Factor on the variance: stretches overlap, so that few of them are independent."""


def period_ns(stamps: IntArray) -> float:
    """Return the interval between samples (M,), M ≥ 2, whatever gaps there are."""
    return float(np.median(np.diff(stamps)))


def gap_variance(stamps: IntArray, values: FloatArray, gap_ns: int) -> FloatArray:
    """Return the variance per second (2,) of gyroscope (rad/s)²s and accelerometer (m/s²)²s across a gap that is interpolated.

    Their product with the length of the gap is the variance of the integral over it.

    Args:
        stamps: (M,) of the samples before the gap, ascending.
        values: (M, 6), gyroscope and accelerometer.
        gap_ns: length of the gap.
    """
    gap_s = gap_ns * 1e-9
    length = max(round(gap_ns / period_ns(stamps)), 2) if len(stamps) > 1 else len(stamps)
    if len(stamps) - length < _LEAST_STRETCHES:
        return _UNKNOWN**2 * gap_s
    times = (stamps - stamps[0]) * 1e-9
    steps = np.diff(times)[:, None] * 0.5 * (values[1:] + values[:-1])
    integral = np.concatenate([np.zeros((1, 6)), np.cumsum(steps, axis=0)])
    span = times[length:] - times[:-length]
    line = 0.5 * (values[length:] + values[:-length]) * span[:, None]
    whole = span < HOLE * gap_s
    error = (integral[length:] - integral[:-length] - line)[whole]
    if len(error) < _LEAST_STRETCHES:
        return _UNKNOWN**2 * gap_s
    result: FloatArray = _FEW * (error**2).mean(axis=0).reshape(2, 3).mean(axis=1) / gap_s
    return result
