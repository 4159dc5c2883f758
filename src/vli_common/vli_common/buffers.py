"""Stamped bounded buffers whose answers carry a reason, so that the caller decides to wait, drop or reset.

A question has three kinds of answer: :class:`Found`, :class:`NotYet` (the data may still come) and :class:`Never` (it will not).
"""

from __future__ import annotations

import bisect
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeAlias, TypeVar

from vli_common.types import NANOSECONDS, Counters

T = TypeVar("T")


class Push(Enum):
    """What became of a pushed item; the value is the name of its counter."""

    ACCEPTED = "accepted"
    DUPLICATE = "duplicate"
    """An item of this stamp is there already: the first one stays."""
    OUT_OF_ORDER = "out_of_order"
    """Older than the newest; kept, in its place, where the buffer allows it, else dropped."""
    TOO_OLD = "too_old"
    """Older than all that the buffer may still hold: dropped."""


class Reason(Enum):
    """Why a stamp will never be found."""

    EMPTY_INTERVAL = "the interval holds no stamp"
    EXPIRED = "older than what the buffer holds"
    SKIPPED = "newer items are there, this stamp is not"


@dataclass(frozen=True, slots=True)
class Found(Generic[T]):
    """The answer, with the stamp it belongs to."""

    stamp_ns: int
    value: T


@dataclass(frozen=True, slots=True)
class NotYet:
    """The newest item is older than the question; ``missing_ns`` is by how much (None for an empty buffer)."""

    missing_ns: int | None


@dataclass(frozen=True, slots=True)
class Never:
    """The question will not be answered, whatever comes."""

    reason: Reason


Answer: TypeAlias = Found[T] | NotYet | Never


class StampedBuffer(Generic[T]):
    """Items by stamp, ascending, at most ``capacity`` and none older than ``horizon_ns`` before the newest.

    Args:
        capacity: items; the oldest is evicted (and counted) where one more comes.
        horizon_ns: age limit relative to the newest stamp, or None.
        keep_late: True keeps an item that comes out of order (in its place); False drops it.
    """

    def __init__(self, capacity: int, horizon_ns: int | None = 10 * NANOSECONDS, keep_late: bool = False) -> None:
        if capacity < 1:
            raise ValueError(f"capacity is '{capacity}', expected at least 1")
        self.counters = Counters()
        self._capacity, self._horizon_ns, self._keep_late = capacity, horizon_ns, keep_late
        self._stamps: list[int] = []
        self._items: list[T] = []
        self._forgotten_ns: int | None = None

    def __len__(self) -> int:
        return len(self._stamps)

    def __iter__(self) -> Iterator[T]:
        """Yield the items, the oldest first."""
        return iter(self._items)

    @property
    def newest_ns(self) -> int | None:
        """Newest stamp, or None."""
        return self._stamps[-1] if self._stamps else None

    @property
    def oldest_ns(self) -> int | None:
        """Oldest stamp, or None."""
        return self._stamps[0] if self._stamps else None

    def push(self, stamp_ns: int, item: T) -> Push:
        """Add an item, evict what is too old; everything but ACCEPTED is counted under its name."""
        result = self._place(stamp_ns, item)
        if result is not Push.ACCEPTED:
            self.counters.add(result.value)
        self._evict()
        return result

    def at(self, stamp_ns: int) -> Answer[T]:
        """Return the item of exactly this stamp."""
        index = bisect.bisect_left(self._stamps, stamp_ns)
        if index < len(self._stamps) and self._stamps[index] == stamp_ns:
            return Found(stamp_ns, self._items[index])
        if self._is_forgotten(stamp_ns):
            return Never(Reason.EXPIRED)
        return self._not_yet(stamp_ns) if index == len(self._stamps) else Never(Reason.SKIPPED)

    def nearest(self, stamp_ns: int, within_ns: int) -> Answer[T]:
        """Return the item closest in time, at most ``within_ns`` away; waits until nothing closer can come."""
        newest = self.newest_ns
        index = bisect.bisect_left(self._stamps, stamp_ns)
        near = range(max(0, index - 1), min(len(self._stamps), index + 1))
        best = min(near, key=lambda i: abs(self._stamps[i] - stamp_ns), default=None)
        distance = within_ns + 1 if best is None else abs(self._stamps[best] - stamp_ns)
        if newest is None or newest < stamp_ns + min(distance, within_ns):
            return Never(Reason.EXPIRED) if self._is_forgotten(stamp_ns + within_ns) else self._not_yet(stamp_ns)
        if best is None or distance > within_ns:
            return Never(Reason.EXPIRED if self._is_forgotten(stamp_ns) else Reason.SKIPPED)
        return Found(self._stamps[best], self._items[best])

    def between(self, after_ns: int, until_ns: int) -> Answer[list[T]]:
        """Return all items with ``after_ns`` < stamp ≤ ``until_ns`` (possibly none), once one at or past the end is there."""
        if until_ns <= after_ns:
            return Never(Reason.EMPTY_INTERVAL)
        if self._is_forgotten(after_ns + 1):
            return Never(Reason.EXPIRED)
        if self.newest_ns is None or self.newest_ns < until_ns:
            return self._not_yet(until_ns)
        first, last = bisect.bisect_right(self._stamps, after_ns), bisect.bisect_right(self._stamps, until_ns)
        return Found(until_ns, self._items[first:last])

    def pop_until(self, stamp_ns: int) -> list[T]:
        """Remove and return all items up to and including a stamp; questions about them answer EXPIRED from now on."""
        count = bisect.bisect_right(self._stamps, stamp_ns)
        items = self._items[:count]
        self._forget(count)
        return items

    def clear(self) -> None:
        """Forget everything, also what has expired: a new session begins."""
        self._stamps.clear()
        self._items.clear()
        self._forgotten_ns = None

    def _place(self, stamp_ns: int, item: T) -> Push:
        index = bisect.bisect_left(self._stamps, stamp_ns)
        if index < len(self._stamps) and self._stamps[index] == stamp_ns:
            return Push.DUPLICATE
        if self._is_forgotten(stamp_ns):
            return Push.TOO_OLD
        late = index < len(self._stamps)
        if not late or self._keep_late:
            self._stamps.insert(index, stamp_ns)
            self._items.insert(index, item)
        return Push.OUT_OF_ORDER if late else Push.ACCEPTED

    def _evict(self) -> None:
        excess = max(0, len(self._stamps) - self._capacity)
        self.counters.add("evicted", excess)
        if self._horizon_ns is not None and self._stamps:
            excess = max(excess, bisect.bisect_left(self._stamps, self._stamps[-1] - self._horizon_ns))
        self._forget(excess)

    def _forget(self, count: int) -> None:
        if count:
            self._forgotten_ns = self._stamps[count - 1]
            del self._stamps[:count], self._items[:count]

    def _is_forgotten(self, stamp_ns: int) -> bool:
        return self._forgotten_ns is not None and stamp_ns <= self._forgotten_ns

    def _not_yet(self, stamp_ns: int) -> NotYet:
        newest = self.newest_ns if self._stamps else self._forgotten_ns
        return NotYet(None if newest is None else stamp_ns - newest)
