"""What each long frame costs, by stage: ``timing.csv`` and the milliseconds of ``summary.json``."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np

from vli_bringup.stamps import seconds_text
from vli_common.arrays import FloatArray

STAGES = ("decode", "demux", "stripe", "frontend", "backend", "mapping")

_Costs = dict[str, float]
_TOTAL = "total"


class FrameTimer:
    """Attributes time to long frames: a frame's own, its short frame's and its IMU samples', until the next long frame.

    A stage's column is the time of the thread that did its work. ``total`` is wall time of the pipeline, from the moment that a
    frame's turn comes until the next one's does, waiting for other threads included: the totals of all frames add up to the run's
    wall time. As three threads share the work, it is less than the sum of the stages.
    """

    def __init__(self) -> None:
        self._stamps_ns: list[int] = []
        self._rows: list[_Costs] = []
        self._current: _Costs = _no_costs()
        self._mark_s = 0.0

    def start(self) -> None:
        """Let the wall time of the frame at hand run."""
        self._mark_s = time.perf_counter()

    def lap(self) -> None:
        """Give the wall time since the last start or lap to the frame at hand."""
        now_s = time.perf_counter()
        self._current[_TOTAL] += now_s - self._mark_s
        self._mark_s = now_s

    def charge(self, stage: str) -> AbstractContextManager[None]:
        """Return what adds the time of a block, in whatever thread, to the frame that is at hand now; one thread a stage."""
        return _charge(self._current, stage)

    def sorted_in(self, stamp_ns: int, is_long: bool, costs: Mapping[str, float]) -> None:
        """Say what an image is and what it has cost so far; a long one is the frame at hand from now on.

        The wait for this image counts to the frame that it belongs to.
        """
        if is_long:
            if self._stamps_ns:
                self._current = _no_costs()
            self._stamps_ns.append(stamp_ns)
            self._rows.append(self._current)
        for stage, seconds in costs.items():
            self._current[stage] += seconds

    def milliseconds(self) -> FloatArray:
        """Return (N, 7) ms: a row a long frame, a column a stage of :data:`STAGES`, and the wall time last."""
        columns = (*STAGES, _TOTAL)
        return 1e3 * np.array([[row[column] for column in columns] for row in self._rows]).reshape(-1, len(columns))

    def write(self, path: Path) -> None:
        """Write ``timing.csv``."""
        lines = [",".join(["stamp", *(f"{stage}_ms" for stage in STAGES), "total_ms"])]
        for stamp_ns, row in zip(self._stamps_ns, self.milliseconds(), strict=True):
            lines.append(",".join([seconds_text(stamp_ns), *(f"{value:.3f}" for value in row)]))
        path.write_text("\n".join(lines) + "\n")

    def summary(self) -> dict[str, float | None]:
        """Return mean and 95th percentile of the wall time per long frame; None without frames."""
        total = self.milliseconds()[:, -1]
        if not len(total):
            return {"ms_per_frame_mean": None, "ms_per_frame_p95": None}
        return {
            "ms_per_frame_mean": round(float(total.mean()), 3),
            "ms_per_frame_p95": round(float(np.percentile(total, 95)), 3),
        }


@contextmanager
def _charge(costs: _Costs, stage: str) -> Iterator[None]:
    start_s = time.perf_counter()
    yield
    costs[stage] += time.perf_counter() - start_s


def _no_costs() -> _Costs:
    return dict.fromkeys((*STAGES, _TOTAL), 0.0)
