"""What an image looks like at some of its corners, whatever the light: for finding again a place that was seen before.

The light travels with the camera, so that the same print is bright in the middle of one image and dark at the edge of another.
Corners and their descriptors (ORB: Rublee et al., "ORB: an efficient alternative to SIFT or SURF", 2011) are therefore taken from
images whose local mean and contrast are the same everywhere. Half of VGA is enough: the stripes do the fine part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np

from vli_common.arrays import ByteArray, FloatArray
from vli_common.camera import CameraModel

DESCRIPTOR_BYTES = 32
THUMBNAIL_WIDTH = 160
_WIDTH = 320
_MAX_FEATURES, _LEVELS, _BORDER_PX = 500, 5, 19
_NEIGHBOURHOOD = 41
"""Pixels, of an image of ``_WIDTH``, over which mean and contrast are made equal: a tenth of the view."""
_GAIN, _NOISE = 40.0, 4.0
"""Grey levels: what one standard deviation becomes, and what noise adds to it, lest blank parts become texture."""


@dataclass(frozen=True, slots=True)
class ImageFeatures:
    """Corners of one image.

    Args:
        pixels: (N, 2) float64, raw pixels of the image.
        descriptors: (N, 32) uint8, compared by Hamming distance.
        thumbnail: (H, 160) uint8, the image with local mean and contrast made equal.
        scale: raw pixels per pixel of the image in which the corners were found.
    """

    pixels: FloatArray
    descriptors: ByteArray
    thumbnail: ByteArray
    scale: float

    def __len__(self) -> int:
        return len(self.pixels)

    def with_rays(self, camera: CameraModel) -> tuple[ImageFeatures, FloatArray]:
        """Return the corners that have a viewing ray, and their rays (N, 2): a fisheye may see what is beyond 90°."""
        rays = camera.unproject(self.pixels)
        ahead = np.isfinite(rays).all(axis=1)
        return replace(self, pixels=self.pixels[ahead], descriptors=self.descriptors[ahead]), rays[ahead]


def describe_image(pixels: ByteArray) -> ImageFeatures:
    """Return the corners of an image (H, W, 3) BGR or (H, W) grey, the strongest first."""
    levelled = level(pixels, _WIDTH)
    thumbnail = _resized(levelled, THUMBNAIL_WIDTH)
    scale = pixels.shape[1] / levelled.shape[1]
    corners, descriptors = _detector().detectAndCompute(levelled, None)
    if not len(corners):
        return ImageFeatures(np.empty((0, 2)), np.empty((0, DESCRIPTOR_BYTES), np.uint8), thumbnail, scale)
    order = np.argsort([-corner.response for corner in corners], kind="stable")
    where = np.array([corner.pt for corner in corners])[order]
    return ImageFeatures((where + 0.5) * scale - 0.5, np.ascontiguousarray(descriptors[order]), thumbnail, scale)


def level(pixels: ByteArray, width: int) -> ByteArray:
    """Return an image at most ``width`` wide, grey, with the same mean and contrast everywhere."""
    grey = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    small = _resized(np.asarray(grey, np.uint8), width).astype(np.float32)
    side = max(3, _NEIGHBOURHOOD * small.shape[1] // _WIDTH) | 1
    mean = cv2.blur(small, (side, side))
    variance = cv2.blur(small * small, (side, side)) - mean * mean
    contrast = np.sqrt(np.maximum(variance, 0.0)) + np.float32(_NOISE)
    result: ByteArray = np.clip(128.0 + _GAIN * (small - mean) / contrast, 0, 255).astype(np.uint8)
    return result


def _resized(grey: ByteArray, width: int) -> ByteArray:
    if grey.shape[1] <= width:
        return grey
    size = (width, round(grey.shape[0] * width / grey.shape[1]))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)


@cache
def _detector() -> cv2.ORB:
    return cv2.ORB.create(nfeatures=_MAX_FEATURES, nlevels=_LEVELS, edgeThreshold=_BORDER_PX)
