"""Grey images in which a light that travels with the camera does little harm.

The LED and the vignetting move with the camera, not with the scene, and pull Lucas–Kanade along. A local normalisation
removes most of it for tracking, which is done at half the size: the alignment to the patch seen at birth, which models the rest
of the light, works on the full grey and has the last word on the position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from numba import njit

from vli_common.arrays import ByteArray, Float32Array
from vli_common.types import Image

_GREY_PER_SIGMA = 40.0
"""Grey levels of the normalised image for one local standard deviation: ± 3.2 of them fit into 8 bit."""
_NOISE_VARIANCE = 2.0
"""Variance (grey levels²) below which structure is noise: keeps empty areas grey instead of blowing them up."""


@dataclass(frozen=True, slots=True)
class Frame:
    """The versions of a long frame that tracking needs, uint8.

    Args:
        stamp_ns: of the image.
        grey: (H, W), low-passed by [1 2 1]² (demosaicing leaves artefacts at the highest frequencies).
        half: (H/2, W/2), half the size; pixel (x, y) lies at (2x, 2y) of ``grey``.
        normalised: (H/2, W/2), (half − local mean) / local standard deviation, mid-grey 128.
    """

    stamp_ns: int
    grey: ByteArray
    half: ByteArray
    normalised: ByteArray


def make_frame(image: Image, window_px: int) -> Frame:
    """Return the versions of an image; ``window_px`` of the full size, below 3 nothing is normalised."""
    grey = cv2.cvtColor(image.pixels, cv2.COLOR_BGR2GRAY) if image.is_colour else np.ascontiguousarray(image.pixels)
    grey = cv2.GaussianBlur(grey, (3, 3), 0)
    half = cast(ByteArray, cv2.pyrDown(grey))
    normalised = half if window_px < 3 else normalise_locally(half, 2 * (window_px // 4) + 1)
    return Frame(image.stamp_ns, cast(ByteArray, grey), half, normalised)


def normalise_locally(grey: ByteArray, window_px: int) -> ByteArray:
    """Return (grey − mean) / std over an odd window as 8 bit, same shape (H, W); beyond the border the image is mirrored."""
    window = (window_px, window_px)
    mean = cast(Float32Array, cv2.boxFilter(grey, cv2.CV_32F, window))
    square = cast(Float32Array, cv2.sqrBoxFilter(grey, cv2.CV_32F, window))
    out = np.empty_like(grey)
    _standardise(grey, mean, square, out)
    return out


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _standardise(grey: ByteArray, mean: Float32Array, square: Float32Array, out: ByteArray) -> None:
    height, width = grey.shape
    for y in range(height):
        for x in range(width):
            variance = max(square[y, x] - mean[y, x] * mean[y, x], np.float32(0.0)) + np.float32(_NOISE_VARIANCE)
            value = (np.float32(grey[y, x]) - mean[y, x]) * (np.float32(_GREY_PER_SIGMA) / math.sqrt(variance)) + np.float32(
                128.5
            )
            out[y, x] = np.uint8(np.int32(min(max(value, np.float32(0.0)), np.float32(255.0))))
