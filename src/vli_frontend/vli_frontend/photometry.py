"""Grey images in which a light that travels with the camera does little harm.

The LED and the vignetting move with the camera, not with the scene, and pull Lucas–Kanade along. A local normalisation removes most of it for
tracking; the alignment to the patch seen at birth models the rest and works on the unnormalised grey.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from vli_common.arrays import ByteArray
from vli_common.types import Image

_GREY_PER_SIGMA = 40.0
"""Grey levels of the normalised image for one local standard deviation: ± 3.2 of them fit into 8 bit."""
_NOISE_VARIANCE = 2.0
"""Variance (grey levels²) below which structure is noise: keeps empty areas grey instead of blowing them up."""


@dataclass(frozen=True, slots=True)
class Frame:
    """The two versions of a long frame that tracking needs, both (H, W) uint8.

    Args:
        grey: low-passed by [1 2 1]² (demosaicing leaves artefacts at the highest frequencies).
        normalised: (grey − local mean) / local standard deviation, mid-grey 128.
    """

    grey: ByteArray
    normalised: ByteArray


def make_frame(image: Image, window_px: int) -> Frame:
    """Return the filtered and the locally normalised grey of an image; ``window_px`` is odd or rounded up."""
    grey = cv2.cvtColor(image.pixels, cv2.COLOR_BGR2GRAY) if image.is_colour else np.ascontiguousarray(image.pixels)
    grey = cv2.GaussianBlur(grey, (3, 3), 0)
    normalised = np.empty_like(grey)
    normalise_locally(grey, window_px // 2, normalised)
    return Frame(grey, normalised)


@njit(cache=True, fastmath=True)
def normalise_locally(grey: ByteArray, radius: int, out: ByteArray) -> None:
    """Write (grey − mean) / std over (2 radius + 1)² pixels as 8 bit; beyond the border the window is cut.

    Args:
        grey: (H, W) uint8.
        radius: of the window, pixels.
        out: (H, W) uint8.
    """
    height, width = grey.shape
    sums = np.zeros(width + 2 * radius + 1, np.int32)
    squares = np.zeros(width + 2 * radius + 1, np.int32)
    box_sum = np.empty(width, np.float32)
    box_square = np.empty(width, np.float32)
    columns = np.empty(width, np.float32)
    for x in range(width):
        columns[x] = min(x + radius, width - 1) - max(x - radius, 0) + 1
    for y in range(min(radius, height)):
        _add_row(grey[y], sums[radius + 1 :], squares[radius + 1 :], 1)
    for y in range(height):
        if y + radius < height:
            _add_row(grey[y + radius], sums[radius + 1 :], squares[radius + 1 :], 1)
        if y - radius - 1 >= 0:
            _add_row(grey[y - radius - 1], sums[radius + 1 :], squares[radius + 1 :], -1)
        _box_row(sums, radius, box_sum)
        _box_row(squares, radius, box_square)
        rows = np.float32(min(y + radius, height - 1) - max(y - radius, 0) + 1)
        for x in range(width):
            inverse = np.float32(1.0) / (rows * columns[x])
            mean = box_sum[x] * inverse
            variance = max(box_square[x] * inverse - mean * mean, np.float32(0.0)) + np.float32(_NOISE_VARIANCE)
            value = (np.float32(grey[y, x]) - mean) * (np.float32(_GREY_PER_SIGMA) / math.sqrt(variance)) + np.float32(128.5)
            out[y, x] = np.uint8(min(max(value, np.float32(0.0)), np.float32(255.0)))


@njit(cache=True)
def _add_row(row: ByteArray, sums: np.ndarray, squares: np.ndarray, sign: int) -> None:
    for x in range(len(row)):
        value = np.int32(row[x])
        sums[x] += sign * value
        squares[x] += sign * value * value


@njit(cache=True)
def _box_row(padded: np.ndarray, radius: int, out: np.ndarray) -> None:
    """Write sums over 2 radius + 1 entries of an array padded by radius + 1 zeros before and radius after."""
    total = np.int32(0)
    for x in range(radius + 1, 2 * radius + 1):
        total += padded[x]
    for x in range(len(out)):
        total += padded[x + 2 * radius + 1] - padded[x] if x + 2 * radius + 1 < len(padded) else -padded[x]
        out[x] = total
