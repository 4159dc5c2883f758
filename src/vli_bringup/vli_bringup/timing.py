"""What each long frame costs, by stage: ``timing.csv`` and the milliseconds of ``summary.json``."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from vli_bringup.stamps import seconds_text
from vli_common.arrays import FloatArray

STAGES = ("decode", "demux", "stripe", "frontend", "backend", "mapping")

_Costs = dict[str, float]


class FrameTimer:
    """Attributes wall time to long frames: a frame's own, its short frame's and its IMU samples', until the next long frame.

    Decoding and demultiplexing happen before it is known what an image is, so their cost waits under the image's stamp.
    """

    def __init__(self) -> None:
        self._stamps_ns: list[int] = []
        self._rows: list[_Costs] = []
        self._current: _Costs = dict.fromkeys(STAGES, 0.0)
        self._waiting: dict[int, _Costs] = {}

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Add the time of the block to the frame at hand."""
        start = time.perf_counter()
        yield
        self._current[stage] += time.perf_counter() - start

    @contextmanager
    def measure_unsorted(self, stage: str, stamp_ns: int) -> Iterator[None]:
        """Add the time of the block to the image of this stamp, wherever that will belong."""
        start = time.perf_counter()
        yield
        costs = self._waiting.setdefault(stamp_ns, {})
        costs[stage] = costs.get(stage, 0.0) + time.perf_counter() - start

    def sorted_in(self, stamp_ns: int, is_long: bool) -> None:
        """Say what an image is; a long one is the frame at hand from now on."""
        if is_long:
            if self._stamps_ns:
                self._current = dict.fromkeys(STAGES, 0.0)
            self._stamps_ns.append(stamp_ns)
            self._rows.append(self._current)
        for stage, seconds in self._waiting.pop(stamp_ns, {}).items():
            self._current[stage] += seconds

    def milliseconds(self) -> FloatArray:
        """Return (N, 6) ms: a row a long frame, a column a stage of :data:`STAGES`."""
        return 1e3 * np.array([[row[stage] for stage in STAGES] for row in self._rows]).reshape(-1, len(STAGES))

    def write(self, path: Path) -> None:
        """Write ``timing.csv``."""
        lines = [",".join(["stamp", *(f"{stage}_ms" for stage in STAGES), "total_ms"])]
        for stamp_ns, row in zip(self._stamps_ns, self.milliseconds(), strict=True):
            lines.append(",".join([seconds_text(stamp_ns), *(f"{value:.3f}" for value in (*row, row.sum()))]))
        path.write_text("\n".join(lines) + "\n")

    def summary(self) -> dict[str, float | None]:
        """Return mean and 95th percentile of the time per long frame; None without frames."""
        total = self.milliseconds().sum(axis=1)
        if not len(total):
            return {"ms_per_frame_mean": None, "ms_per_frame_p95": None}
        return {
            "ms_per_frame_mean": round(float(total.mean()), 3),
            "ms_per_frame_p95": round(float(np.percentile(total, 95)), 3),
        }
