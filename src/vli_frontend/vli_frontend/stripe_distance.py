"""How far each feature is from the laser stripe of an adjacent short frame: the features-on-laser."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numba import njit

from vli_common.arrays import FloatArray
from vli_common.types import LaserScan

_KEPT = 4


class StripeDistance:
    """Distances to the stripes of the short frames next to a long one.

    Args:
        reach_ns: a scan farther in time is not adjacent.
    """

    def __init__(self, reach_ns: int) -> None:
        self._reach_ns = reach_ns
        self._scans: deque[LaserScan] = deque(maxlen=_KEPT)

    def clear(self) -> None:
        """Forget all scans."""
        self._scans.clear()

    def add(self, scan: LaserScan) -> None:
        """Take the stripe of a short frame."""
        self._scans.append(scan)

    def measure(self, stamp_ns: int, pixels: FloatArray) -> FloatArray:
        """Return (N,) pixels from each feature (N, 2) to the nearest stripe point, ``inf`` where no adjacent scan has one."""
        result = np.full(len(pixels), np.inf)
        for scan in self._scans:
            if abs(scan.stamp_ns - stamp_ns) <= self._reach_ns and len(scan):
                _lower_to_nearest(pixels, np.ascontiguousarray(scan.pixels), result)
        return result


@njit(cache=True, nogil=True)
def _lower_to_nearest(pixels: FloatArray, stripe: FloatArray, distance: FloatArray) -> None:
    for n in range(len(pixels)):
        best = distance[n] * distance[n]
        for k in range(len(stripe)):
            dx, dy = stripe[k, 0] - pixels[n, 0], stripe[k, 1] - pixels[n, 1]
            best = min(best, dx * dx + dy * dy)
        distance[n] = math.sqrt(best)
