"""Counts frame periods from stamps, so that dropped frames do not shift what comes after."""

from __future__ import annotations

from collections import deque

_HISTORY = 16
_SAME_KIND = 0.4
"""Intervals within this share of the lower quartile are single periods; the others span dropped frames."""
_MAX_PHASE_ERROR = 0.35


class Rhythm:
    """The slot of each frame: frames since the start, those that never arrived included.

    Args:
        max_gap_ns: beyond, the count of missed periods is not trusted.
    """

    def __init__(self, max_gap_ns: int) -> None:
        self._max_gap_ns = max_gap_ns
        self._intervals: deque[int] = deque(maxlen=_HISTORY)
        self.slot = 0

    def advance(self, step_ns: int) -> tuple[int, bool]:
        """Move on by the interval to the next frame, > 0; return how many periods it spans and whether that count is reliable."""
        self._intervals.append(step_ns)
        single = sorted(self._intervals)[(len(self._intervals) - 1) // 4]
        # Mid-exposures of long and short frames need not be evenly spaced: the mean over both kinds is the period.
        same = [interval for interval in self._intervals if abs(interval / single - 1) < _SAME_KIND]
        period = sum(same) / len(same)
        count = max(round(step_ns / period), 1)
        self.slot += count
        return count, abs(step_ns / period - count) < _MAX_PHASE_ERROR and step_ns < self._max_gap_ns
