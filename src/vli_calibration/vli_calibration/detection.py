"""Find a target in images."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2

from vli_calibration.boards import AprilGrid, CharucoBoard, Chessboard, Target
from vli_calibration.detection_chessboard import detect_chessboard
from vli_calibration.detection_tags import detect_aprilgrid, detect_charuco
from vli_calibration.progress import progress
from vli_calibration.types import Detection
from vli_common.arrays import ByteArray

_MOST_WORKERS = 4

_DETECTORS: dict[type[Target], Callable[..., Detection | str]] = {
    Chessboard: detect_chessboard,
    CharucoBoard: detect_charuco,
    AprilGrid: detect_aprilgrid,
}


class TargetDetector:
    """Finds one target's corners, refined to sub-pixel.

    Args:
        target: what to look for.
    """

    def __init__(self, target: Target) -> None:
        self.target = target
        self._detect = _DETECTORS[type(target)]

    def detect(self, pixels: ByteArray) -> Detection | str:
        """Return the corners in one image, (H, W, 3) BGR or (H, W) grey, or the reason why there are none, in words."""
        result = self._detect(self.target, pixels)
        if not isinstance(result, str) and not len(result):
            return "corners found, but none could be refined"
        return result

    def detect_all(self, images: Sequence[ByteArray], text: str = "finding the board") -> list[Detection | str]:
        """Return :meth:`detect` of each image, several at a time, with a progress bar."""
        workers = min(_MOST_WORKERS, len(os.sched_getaffinity(0)))
        threads = cv2.getNumThreads()
        # One thread an image: OpenCV's own would only stand in each other's way.
        cv2.setNumThreads(1)
        try:
            with ThreadPoolExecutor(workers) as pool:
                return list(progress(pool.map(self.detect, images), len(images), text))
        finally:
            cv2.setNumThreads(threads)
