"""A bag at its own pace: each item is handed on when its time has come."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from vli_common.clock import ClockMonitor
from vli_common.config import parameter
from vli_common.types import NANOSECONDS, Counters, EncodedImage, ImuSample

_LATE_S = 0.1
_GAP_NS = 10 * NANOSECONDS
"""Longer steps, between streams too, are none of time: nobody waits for them."""


@dataclass(frozen=True)
class PlaybackConfig:
    """Which bag to play, and how."""

    bag: str = parameter("", doc="rosbag2 directory or bare .mcap; empty: nothing is played")
    rate: float = parameter(1.0, minimum=0.01, maximum=100.0, doc="bag seconds a second; faster than the machine: drops")
    loop: bool = parameter(False, doc="begin anew at the end, as a new session")
    start: float = parameter(0.0, unit="s", minimum=0.0, doc="skip the first seconds")
    duration: float = parameter(0.0, unit="s", minimum=0.0, doc="stop after these seconds; 0: all")
    wait_for: str = parameter("", doc="nodes that must be ready before the first frame, separated by commas")
    wait_timeout: float = parameter(300.0, unit="s", minimum=0.0, doc="play without them after this long")


class BagPlayer:
    """Hands on items so that ``rate`` bag seconds pass in a second of the clock; an item is never early.

    Counters: ``late`` (by more than 0.1 s: the machine does not keep the pace).

    Args:
        rate: bag seconds a second.
        publish: gets each item.
        on_jump: gets the reason and the stamp where the clock of the bag jumps, before the item is published.
        clock: seconds.
    """

    def __init__(
        self,
        rate: float,
        publish: Callable[[EncodedImage | ImuSample], None],
        on_jump: Callable[[str, int], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.counters = Counters()
        self.position_ns = 0
        """Newest stamp that was handed on."""
        self._rate, self._publish, self._on_jump, self._clock = rate, publish, on_jump, clock
        self._stopped, self._running = threading.Event(), threading.Event()
        self._running.set()
        self._anchor: tuple[float, int] | None = None
        self.due: tuple[int, int] | None = None
        """A stamp and the wall clock (ns) at which it was due; those that follow are due in proportion to the rate."""

    def play(self, items: Iterable[EncodedImage | ImuSample]) -> bool:
        """Play to the end; return False where it was stopped before."""
        monitor = ClockMonitor()
        self._anchor = None
        for item in items:
            if jump := monitor.jump("camera" if isinstance(item, EncodedImage) else "IMU", item.stamp_ns):
                self._on_jump(jump.reason, item.stamp_ns)
                self._anchor = None
            self._wait_for(item.stamp_ns)
            if self._stopped.is_set():
                return False
            self._publish(item)
            self.position_ns = item.stamp_ns
        return True

    def pause(self) -> None:
        """Hold after the present item."""
        self._running.clear()

    def resume(self) -> None:
        """Go on where it was held."""
        self._running.set()

    def stop(self) -> None:
        """End at the present item."""
        self._stopped.set()
        self._running.set()

    def rest(self, seconds: float) -> bool:
        """Wait; return False at once where the playback was stopped."""
        return not self._stopped.wait(seconds)

    def _wait_for(self, stamp_ns: int) -> None:
        if not self._running.is_set():
            self._running.wait()
            self._anchor = None
        now_s = self._clock()
        if self._anchor is None or abs(stamp_ns - self.position_ns) > _GAP_NS:
            self._anchor = (now_s, stamp_ns)
            self.due = (stamp_ns, time.time_ns())
        due_s = self._anchor[0] + (stamp_ns - self._anchor[1]) / NANOSECONDS / self._rate
        self.counters.add("late", int(now_s - due_s > _LATE_S))
        if due_s > now_s:
            self._stopped.wait(due_s - now_s)
