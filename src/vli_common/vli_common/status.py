"""What a stage says of itself: state, rates, latency, drops and a hint in words. ROS knows it as diagnostics."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

_SAMPLES = 512


class Health(Enum):
    """Overall judgement; the value is the level of ``diagnostic_msgs/DiagnosticStatus``."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class NodeState(Enum):
    """Where a node stands in its life."""

    UNCONFIGURED = "unconfigured"
    """For a lifecycle manager."""
    WAITING = "waiting"
    """For its calibration."""
    WARMING = "warming"
    """Compiling its kernels."""
    INACTIVE = "inactive"
    """Configured, but told to rest by a lifecycle manager."""
    READY = "ready"
    PAUSED = "paused"
    FINISHED = "finished"
    """The source has no more data (driver), or all of it is processed (the others)."""
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class StageStatus:
    """One status of one node.

    Args:
        stamp_ns: wall clock.
        node: name of the node.
        health: overall judgement.
        state: of the node.
        hint: one line in words: what is wrong and what to do, or empty.
        values: everything else, by name.
    """

    stamp_ns: int
    node: str
    health: Health
    state: NodeState
    hint: str = ""
    values: dict[str, str] = field(default_factory=dict)


class LatencyMeter:
    """Median and 99th percentile of the last 512 durations."""

    def __init__(self) -> None:
        self._seconds: deque[float] = deque(maxlen=_SAMPLES)

    def add(self, seconds: float) -> None:
        """Add one duration."""
        self._seconds.append(seconds)

    def percentiles_ms(self) -> tuple[float, float] | None:
        """Return (p50, p99) in milliseconds, or None before the first sample."""
        if not self._seconds:
            return None
        p50, p99 = np.percentile(list(self._seconds), [50, 99]) * 1e3
        return float(p50), float(p99)


class RateMeter:
    """Events a second since the last reading."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._count, self._since = clock, 0, clock()

    def add(self) -> None:
        """Count one event."""
        self._count += 1

    def read_hz(self) -> float:
        """Return the rate since the last call and start counting anew."""
        now = self._clock()
        elapsed, count = now - self._since, self._count
        self._count, self._since = 0, now
        return count / elapsed if elapsed > 0 else 0.0
