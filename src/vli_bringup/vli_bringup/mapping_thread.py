"""The mapping's part of the pipeline in a thread of its own: what the mapping node does in a process of its own.

While the main thread follows the next frames, the window of a keyframe is related to the map and its scans enter. The answer is
waited for before the next keyframe is solved, which is the first to use it: what comes out does not depend on who was faster.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from vli_bringup.timing import FrameTimer
from vli_common.types import Image, LaserScan, MappingOutput, WindowPoses
from vli_mapping.mapper import Mapper


class MappingThread:
    """Hands images, scans and windows to the mapper in the order they are given.

    Args:
        mapper: as it is wired by the pipeline; nobody else may use it before :meth:`wait` has returned.
        timer: what the work costs is charged to the frame at hand when it was given.
    """

    def __init__(self, mapper: Mapper, timer: FrameTimer) -> None:
        self._mapper, self._timer = mapper, timer
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="mapping")
        self._pending: deque[Future[MappingOutput | None]] = deque()

    def add_image(self, image: Image) -> None:
        """See :meth:`Mapper.add_image`."""
        self._submit(lambda: self._mapper.add_image(image))

    def add_scan(self, scan: LaserScan) -> None:
        """See :meth:`Mapper.add_scan`."""
        self._submit(lambda: self._mapper.add_scan(scan))

    def add_window(self, window: WindowPoses) -> None:
        """See :meth:`Mapper.add_window`; :meth:`wait` has the answer."""
        self._submit(lambda: self._mapper.add_window(window))

    def wait(self) -> list[MappingOutput]:
        """Return the answers to the windows since the last call, when all that was given is done."""
        results = [self._pending.popleft().result() for _ in range(len(self._pending))]
        return [result for result in results if result is not None]

    def _submit(self, work: Callable[[], MappingOutput | None]) -> None:
        charged = self._timer.charge("mapping")

        def run() -> MappingOutput | None:
            with charged:
                return work()

        self._pending.append(self._worker.submit(run))
