"""Peaks of neighbouring profiles to segments of one line.

``found`` and ``located`` are what :mod:`vli_driver.stripe_kernels` gives, peaks and points with their measures, a row a profile.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from vli_driver.stripe_kernels import CANDIDATES

_LEAN_REACH = 4
_MAX_MISSING = 2
"""Missing points that do not end a segment."""


@njit(cache=True, nogil=True)
def _median(values, count):  # type: ignore[no-untyped-def]
    """Return the median of the first ``count`` values (insertion sort in place: they are few)."""
    for i in range(1, count):
        value = values[i]
        j = i - 1
        while j >= 0 and values[j] > value:
            values[j + 1] = values[j]
            j -= 1
        values[j + 1] = value
    return values[count // 2]


@njit(cache=True, nogil=True)
def choose_chain(found, max_jump):  # type: ignore[no-untyped-def]
    """Choose one peak per profile so that the line jumps least, the brighter one where that does not decide (Viterbi).

    Returns:
        (N, 4) peaks chosen, and (N,) bool: there was a choice.
    """
    count = len(found)
    cost, back = np.zeros((count, CANDIDATES)), np.zeros((count, CANDIDATES), np.int64)
    ambiguous = np.zeros(count, np.bool_)
    for i in range(count):
        ambiguous[i] = found[i, 1, 2] > 0
        for k in range(CANDIDATES):
            if k and not ambiguous[i]:
                cost[i, k] = np.inf
                continue
            best, source = np.inf, 0
            for m in range(CANDIDATES):
                jump = 0.0
                if i and found[i, k, 2] > 0 and found[i - 1, m, 2] > 0:
                    apart = 0.5 * abs(found[i, k, 0] + found[i, k, 1] - found[i - 1, m, 0] - found[i - 1, m, 1])
                    jump = 1.0 if apart >= max_jump else 0.0
                before = cost[i - 1, m] if i else 0.0
                if before + jump < best:
                    best, source = before + jump, m
            dimmer = np.log(found[i, 0, 2] / found[i, k, 2]) if k else 0.0
            cost[i, k], back[i, k] = best + dimmer, source
    chosen = np.zeros((count, found.shape[2]))
    state = 0
    if count:
        state = int(np.argmin(cost[count - 1]))
    for i in range(count - 1, -1, -1):
        chosen[i] = found[i, state]
        state = back[i, state]
    return chosen, ambiguous


@njit(cache=True, nogil=True)
def _segment_end(located, keep, start, max_jump):  # type: ignore[no-untyped-def]
    """Return the last profile of the segment that starts at ``start``."""
    last = start
    for j in range(start + 1, len(located)):
        if j - last > _MAX_MISSING + 1:
            break
        if keep[j]:
            if abs(located[j, 0] - located[last, 0]) >= max_jump * (j - last):
                break
            last = j
    return last


@njit(cache=True, nogil=True)
def keep_segments(located, ambiguous, max_jump, min_points, min_colour_ratio):  # type: ignore[no-untyped-def]
    """Return (N,) bool: the profiles whose point lies on a segment that is long, unambiguous and coloured enough."""
    keep = ~np.isnan(located[:, 0])
    i = 0
    while i < len(located):
        if not keep[i]:
            i += 1
            continue
        last = _segment_end(located, keep, i, max_jump)
        number, doubtful, own, other = 0, 0, 0.0, 0.0
        for j in range(i, last + 1):
            if keep[j]:
                number += 1
                doubtful += ambiguous[j]
                own += located[j, 2]
                other += located[j, 5]
        if number < min_points or 2 * doubtful > number or own < min_colour_ratio * other:
            keep[i : last + 1] = False
        i = last + 1
    return keep


@njit(cache=True, nogil=True)
def trim_segments(located, keep, max_jump, trim, min_points):  # type: ignore[no-untyped-def]
    """Clear the first and last ``trim`` points of every segment, where an edge cuts the line, and segments too short by now."""
    i = 0
    while i < len(located):
        if not keep[i]:
            i += 1
            continue
        last = _segment_end(located, keep, i, max_jump)
        number = int(np.sum(keep[i : last + 1]))
        order = 0
        for j in range(i, last + 1):
            if keep[j]:
                keep[j] = number >= min_points and trim <= order < number - trim
                order += 1
        i = last + 1


@njit(cache=True, nogil=True)
def steady_lean(located, keep):  # type: ignore[no-untyped-def]
    """Return (N,) the median lean of each kept point and its neighbours: speckle averages out, a line that an edge cuts leans on.

    The median of the whole frame is taken off: what the optics do to every line is part of the calibrated plane.
    """
    count = len(located)
    lean = np.zeros(count)
    near = np.empty(2 * _LEAN_REACH + 1)
    for i in range(count):
        if not keep[i]:
            continue
        number = 0
        for j in range(max(i - _LEAN_REACH, 0), min(i + _LEAN_REACH, count - 1) + 1):
            if keep[j] and abs(located[j, 0] - located[i, 0]) < 3 * max(abs(j - i), 1):
                near[number] = located[j, 6]
                number += 1
        lean[i] = _median(near, number)
    if keep.any():
        lean -= np.median(lean[keep])
    return lean
