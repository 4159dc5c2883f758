"""How bright a frame is, whatever bright line crosses it."""

from __future__ import annotations

import numpy as np
from numba import njit

from vli_common.arrays import ByteArray

STEP = 8
"""Every eighth pixel in either direction is looked at."""
_TRIM = 0.05
"""Share of the brightest samples left out: a stripe covers less, whatever its own brightness."""


def brightness(pixels: ByteArray) -> float:
    """Return the trimmed mean grey level (0 to 255) of an image (H, W) or (H, W, 3)."""
    return float(_trimmed_mean(pixels if pixels.ndim == 3 else pixels[:, :, None], STEP, _TRIM))


@njit(cache=True, nogil=True)
def _trimmed_mean(pixels, step, trim):  # type: ignore[no-untyped-def]
    """Return the mean of the darkest (1 − trim) of the samples' channel means, from a histogram."""
    histogram = np.zeros(256, np.int64)
    channels = pixels.shape[2]
    total = 0
    for v in range(step // 2, pixels.shape[0], step):
        for u in range(step // 2, pixels.shape[1], step):
            level = 0
            for c in range(channels):
                level += pixels[v, u, c]
            histogram[level // channels] += 1
            total += 1
    left = total - int(total * trim)
    count, weighted = 0, 0
    for level in range(256):
        take = min(histogram[level], left - count)
        weighted += take * level
        count += take
    return weighted / max(count, 1)
