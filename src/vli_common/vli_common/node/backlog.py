"""Tells a node that is too slow for its input from one that was held up for a moment.

A short delay is made up for, and nothing need be lost; a delay that lasts must be cut by leaving something out. The rule is that
of controlled delay (CoDel, RFC 8289): what counts is not the length of the queue but how long its messages have waited, and
whether they have done so for a whole interval.
"""

from __future__ import annotations

import time
from collections.abc import Callable

TARGET_S = 0.1
"""Messages that have waited longer are late. Two stages in a row that are too slow still answer within 200 ms."""
INTERVAL_S = 2.0


class Backlog:
    """Whether a queue is behind for good.

    Args:
        clock: seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._late_since_s: float | None = None
        self._last_late_s = 0.0
        self._is_shedding = False

    def is_behind(self, arrived_s: float) -> bool:
        """Take when the message whose turn it is arrived; return True where it should be left out, if that can be done.

        So once messages have been late for an interval, and until none has been for another.
        """
        now_s = self._clock()
        if now_s - arrived_s > TARGET_S:
            self._last_late_s = now_s
            self._late_since_s = now_s if self._late_since_s is None else self._late_since_s
            self._is_shedding = self._is_shedding or now_s - self._late_since_s >= INTERVAL_S
            return self._is_shedding
        if not self._is_shedding or now_s - self._last_late_s >= INTERVAL_S:
            self._late_since_s, self._is_shedding = None, False
        return False
