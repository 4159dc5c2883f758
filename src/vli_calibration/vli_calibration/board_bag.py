"""The board in the long frames of a bag, found while the bag is read."""

from __future__ import annotations

import os
from collections import Counter, deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import cv2

from vli_calibration.bag_images import sorted_frames
from vli_calibration.boards import Target
from vli_calibration.detection import TargetDetector
from vli_calibration.types import Detection
from vli_common.arrays import ByteArray
from vli_common.camera import CameraModel
from vli_common.errors import InputError
from vli_common.types import NANOSECONDS, Exposure, Image
from vli_driver.bag import DEFAULT_IMAGE_TOPIC, BagReader, BagTopics

_ENOUGH_FRAMES = 600
_WIDEST_NS = NANOSECONDS // 10
"""Frames are thinned, evenly and at most to this distance, until there are enough: more only take longer."""
_WORKERS = 4


@dataclass
class BoardFrames:
    """Frames of a bag with their corners.

    Args:
        stamps_ns, detections: of the frames with a board, in order.
        total: frames that were searched.
        failures: reason → number of frames without a board.
        example: one of those frames, as (stamp, pixels).
    """

    stamps_ns: list[int] = field(default_factory=list)
    detections: list[Detection] = field(default_factory=list)
    total: int = 0
    failures: Counter[str] = field(default_factory=Counter)
    example: tuple[int, ByteArray] | None = None

    def add(self, image: Image, found: Detection | str) -> None:
        """Take the result of one frame."""
        self.total += 1
        if isinstance(found, str):
            self.failures[found] += 1
            self.example = self.example or (image.stamp_ns, image.pixels)
            return
        self.stamps_ns.append(image.stamp_ns)
        self.detections.append(found)


def find_board(path: Path, target: Target, camera: CameraModel, topic: str = DEFAULT_IMAGE_TOPIC) -> BoardFrames:
    """Return the corners in the long frames of a bag.

    Raises:
        InputError: no bag, no images, or images that are not of the calibrated size.
    """
    reader = BagReader(path, BagTopics(image=topic, imu_required=False))
    start_ns, end_ns = reader.time_range_ns
    step_ns = min(_WIDEST_NS, (end_ns - start_ns) // _ENOUGH_FRAMES)
    frames = BoardFrames()
    for image, found in _search(_thinned(reader, step_ns, camera), TargetDetector(target)):
        frames.add(image, found)
    if not frames.total:
        raise InputError(f"topic '{reader.image_topic}' in '{path}' holds no long frame; record again")
    return frames


def _thinned(reader: BagReader, step_ns: int, camera: CameraModel) -> Iterator[Image]:
    """Yield long frames at least ``step_ns`` apart."""
    last_ns: int | None = None
    for exposure, image in sorted_frames(reader, "finding the board"):
        if exposure is not Exposure.LONG or (last_ns is not None and image.stamp_ns < last_ns + step_ns):
            continue
        height, width = image.pixels.shape[:2]
        if (width, height) != (camera.width, camera.height):
            raise InputError(
                f"image is '{width} x {height}', the calibration is for {camera.width} x {camera.height}; "
                "use the calibration of this camera and resolution"
            )
        last_ns = image.stamp_ns
        yield image


def _search(images: Iterator[Image], detector: TargetDetector) -> Iterator[tuple[Image, Detection | str]]:
    """Yield each image with what was found, a few of them at a time; none is kept longer than that."""
    workers = min(_WORKERS, len(os.sched_getaffinity(0)))
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # one an image: OpenCV's own would only stand in each other's way
    try:
        with ThreadPoolExecutor(workers) as pool:
            pending: deque[tuple[Image, Future[Detection | str]]] = deque()
            for image in images:
                pending.append((image, pool.submit(detector.detect, image.pixels)))
                if len(pending) > 2 * workers:
                    yield _result(pending)
            while pending:
                yield _result(pending)
    finally:
        cv2.setNumThreads(threads)


def _result(pending: deque[tuple[Image, Future[Detection | str]]]) -> tuple[Image, Detection | str]:
    image, future = pending.popleft()
    return image, future.result()
