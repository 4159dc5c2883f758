"""How long the graph takes: from the moment a long frame is taken until its pose is out."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from vli_bringup.stamps import seconds_text
from vli_common.arrays import FloatArray

_PLAUSIBLE_S = 10.0
_MS = 1e-6


class FrameLatencies:
    """Relates the stamps of frames to when their poses came.

    A frame of a bag is taken when its time has come: the driver tells which stamp was due when, again after each pause and jump
    of the clock; what the machine is late with counts to the frame. A camera that is there stamps with the wall clock.

    Args:
        rate: bag seconds a second, 1 for a camera.
    """

    def __init__(self, rate: float = 1.0) -> None:
        self._rate = rate
        self._due: dict[int, int] = {}
        self._published: dict[int, int] = {}

    def add_due(self, stamp_ns: int, wall_ns: int) -> None:
        """Take when a stamp was due; those that follow are due in proportion."""
        self._due[stamp_ns] = wall_ns

    def add_pose(self, stamp_ns: int, wall_ns: int) -> None:
        """Take when the pose of a long frame came."""
        self._published[stamp_ns] = wall_ns

    def milliseconds(self) -> dict[int, float]:
        """Return stamp → latency of each pose; nothing of a camera whose stamps are of another clock."""
        if not self._published:
            return {}
        stamps, published = np.array(list(self._published)), np.array(list(self._published.values()))
        values = (published - self._due_at(stamps)) * _MS
        plausible = bool(self._due) or abs(float(np.median(values))) < 1e3 * _PLAUSIBLE_S
        return dict(zip(stamps.tolist(), values.tolist(), strict=True)) if plausible else {}

    def write(self, path: Path) -> None:
        """Write ``timing.csv``, a line a pose."""
        lines = [f"{seconds_text(stamp)},{value:.3f}" for stamp, value in self.milliseconds().items()]
        path.write_text("\n".join(["stamp,latency_ms", *lines]) + "\n")

    def summary(self) -> Mapping[str, float | None]:
        """Return median and 99th percentile, None without poses."""
        values = list(self.milliseconds().values())
        p50, p99 = np.percentile(values, [50, 99]).round(3).tolist() if values else (None, None)
        return {"latency_ms_p50": p50, "latency_ms_p99": p99}

    def _due_at(self, stamps: FloatArray) -> FloatArray:
        """Return when frames (N,) were due: counted from the last that is known before each."""
        if not self._due:
            return stamps
        known = np.array(sorted(self._due))
        wall = np.array([self._due[stamp] for stamp in known.tolist()])
        last = np.maximum(np.searchsorted(known, stamps, side="right") - 1, 0)
        due: FloatArray = wall[last] + ((stamps - known[last]) / self._rate).astype(np.int64)
        return due
