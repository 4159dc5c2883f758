"""Poses between those of a path, by cubics: a hand trembles too fast for straight lines between long frames.

Of a tremor of 8 Hz, a line between frames 33 ms apart misses a third, the cubic through four of them a seventh.
"""

from __future__ import annotations

import numpy as np

from vli_common.arrays import BoolArray, FloatArray, IntArray
from vli_common.geometry import interpolate, so3_exp, so3_log

_EVEN = 1.2
"""Longest over shortest of the intervals that a second difference joins; where frames are missing, lines must do."""


def interpolate_path(stamps: IntArray, poses: FloatArray, wanted: IntArray) -> FloatArray:
    """Return poses (M, 4, 4) at ``wanted`` (M,) stamps, ns.

    Each is the linear interpolation of its two neighbours, plus the term of the cubic through four (Lagrange), or of the parabola
    through three at the ends of the path.

    Args:
        stamps: (N,) of the path, N ≥ 2, ascending.
        poses: (N, 4, 4).
        wanted: within the path.
    """
    if not len(wanted):
        return np.empty((0, 4, 4))
    i = np.clip(np.searchsorted(stamps, wanted, side="right") - 1, 0, len(stamps) - 2)
    alpha = (wanted - stamps[i]) / (stamps[i + 1] - stamps[i])
    result = interpolate(poses[i], poses[i + 1], alpha)
    if len(stamps) == 2:
        return result
    bend = _bend(stamps, poses, i, alpha)
    result[:, :3, :3] = result[:, :3, :3] @ so3_exp(bend[:, :3])
    result[:, :3, 3] += bend[:, 3:]
    return result


def _bend(stamps: IntArray, poses: FloatArray, i: IntArray, alpha: FloatArray) -> FloatArray:
    """Return how far the cubic is from the line, (M, 6): rotation vector in the camera, translation in the map."""
    second, known = _second_differences(stamps, poses)
    start, end = second[i], second[i + 1]
    start = np.where(known[i, None], start, end)
    end = np.where(known[i + 1, None], end, start)
    a = alpha[:, None]
    result: FloatArray = 0.5 * a * (a - 1.0) * ((2.0 - a) * start + (1.0 + a) * end) / 3.0
    return result


def _second_differences(stamps: IntArray, poses: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return f(i − 1) − 2 f(i) + f(i + 1), (N, 6), zero where not known, and where it is, (N,)."""
    rotations, steps = poses[:, :3, :3], np.diff(stamps)
    turns = so3_log(rotations[:-1].transpose(0, 2, 1) @ rotations[1:])
    motion = np.concatenate([turns, np.diff(poses[:, :3, 3], axis=0)], axis=1)
    known = np.zeros(len(stamps), np.bool_)
    known[1:-1] = np.maximum(steps[1:], steps[:-1]) < _EVEN * np.minimum(steps[1:], steps[:-1])
    result = np.zeros((len(stamps), 6))
    result[1:-1] = np.diff(motion, axis=0)
    result[~known] = 0.0
    return result, known
