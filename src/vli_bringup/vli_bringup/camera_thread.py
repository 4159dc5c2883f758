"""The camera's part of the pipeline in a thread of its own: what driver and demultiplexer do in processes of theirs.

While the main thread follows and estimates a long frame, its short frame is decoded and triangulated, and the next long one made
ready for the front end. Kernels, codecs and OpenCV release the interpreter, so two cores do the work of two; what comes out does
not depend on who was faster.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

from vli_common.errors import InputError
from vli_common.types import Counters, EncodedImage, Exposure, Image, LaserScan
from vli_driver.decode import decode
from vli_driver.demux import Demultiplexer
from vli_driver.scanner import StripeScanner
from vli_frontend.photometry import Frame


@dataclass(frozen=True, slots=True)
class SortedImage:
    """An image with its verdict.

    Args:
        exposure: long or short.
        image: decoded.
        scan: the stripe of a short one, eq. (1); None for a long one and where there is no scanner.
        frame: a long one as the front end takes it; None for a short one.
        costs: seconds by stage, of the thread that did the work.
    """

    exposure: Exposure
    image: Image
    scan: LaserScan | None
    frame: Frame | None
    costs: dict[str, float]


@dataclass(slots=True)
class _Costs:
    """Seconds by stage of one image."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Add the time of what runs within to a stage."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


class CameraThread:
    """Decodes, sorts and triangulates images in the order they are given.

    Counters: ``undecodable_images``, ``images_of_another_shape``; read them between :meth:`push` and :meth:`flush` only through a
    result that has come.

    Args:
        demultiplexer, scanner: as they are wired by the pipeline; nobody else may use them meanwhile. No scanner: no stripe.
        prepare: the front end's, see :meth:`FrontEnd.prepare`.
    """

    def __init__(self, demultiplexer: Demultiplexer, scanner: StripeScanner | None, prepare: Callable[[Image], Frame]) -> None:
        self.counters = Counters()
        self._demultiplexer = demultiplexer
        self._scanner = scanner
        self._prepare = prepare
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="camera")
        self._image_shape: tuple[int, ...] | None = None
        self._costs: dict[int, _Costs] = {}

    def push(self, encoded: EncodedImage, session: int) -> Future[list[SortedImage]]:
        """Take the next image; the answer has those decided with it, in order."""
        return self._worker.submit(self._sort, encoded, session)

    def flush(self) -> Future[list[SortedImage]]:
        """Ask for the images that still wait for a verdict."""
        return self._worker.submit(lambda: [self._scanned(*item) for item in self._demultiplexer.flush()])

    def _sort(self, encoded: EncodedImage, session: int) -> list[SortedImage]:
        costs = self._costs.setdefault(encoded.stamp_ns, _Costs())
        try:
            with costs.measure("decode"):
                image = replace(decode(encoded), session=session)
        except InputError:
            self.counters.add("undecodable_images")
            return []
        self._image_shape = self._image_shape or image.pixels.shape
        if image.pixels.shape != self._image_shape:
            self.counters.add("images_of_another_shape")
            return []
        with costs.measure("demux"):
            ready = self._demultiplexer.push(image)
        return [self._scanned(*item) for item in ready]

    def _scanned(self, exposure: Exposure, image: Image) -> SortedImage:
        costs = self._costs.pop(image.stamp_ns, _Costs())
        scan = frame = None
        if exposure is Exposure.LONG:
            with costs.measure("frontend"):
                frame = self._prepare(image)
        elif self._scanner is not None:
            with costs.measure("stripe"):
                scan = self._scanner.scan(image)
        return SortedImage(exposure, image, scan, frame, costs.seconds)
