"""Images made easier for a detector: even contrast, even light, another size."""

from __future__ import annotations

import cv2
import numpy as np

from vli_common.arrays import ByteArray

_CLIP = 4.0
_TILES = (8, 8)
_LIGHT_OF_SIDE = 1 / 25
_MIDDLE_GREY = 110.0
_BLACK_GREY = 4.0


def scaled(grey: ByteArray, scale: float) -> ByteArray:
    """Return the image (H, W) resized; pixel u of it is (u + 0.5) / scale − 0.5 of the original."""
    if scale == 1.0:
        return grey
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=way), dtype=np.uint8)


def equalised(grey: ByteArray) -> ByteArray:
    """Return the image (H, W) with its histogram equalised tile by tile (CLAHE)."""
    return np.asarray(cv2.createCLAHE(clipLimit=_CLIP, tileGridSize=_TILES).apply(grey), dtype=np.uint8)


def flattened(grey: ByteArray) -> ByteArray:
    """Return the image (H, W) divided by the light round about: glare, the laser's glow and the lamp's fall-off leave."""
    image = grey.astype(np.float32) + _BLACK_GREY
    light = cv2.GaussianBlur(image, (0, 0), max(grey.shape) * _LIGHT_OF_SIDE)
    return np.asarray(np.clip(_MIDDLE_GREY * image / light, 0, 255), dtype=np.uint8)
