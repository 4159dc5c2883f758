"""What is wrong with the stripe, in words for who holds the scanner: too far, too near, saturated."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from vli_common.arrays import ByteArray
from vli_common.calibration import Calibration
from vli_common.types import LaserScan
from vli_driver.config import StripeConfig
from vli_driver.stripe import CentreOfMassDetector
from vli_driver.triangulation import Triangulator, search_band

_SCANS = 30
"""A second: what a hint is about lasts, a glance to the side does not."""
_LOOK_EVERY = 6
"""Scans without a stripe, of which one is searched beyond the range too: that takes as long as a scan."""
_BEYOND = 3.0
"""The range is searched from a third of its near end to three times its far end."""
_SATURATED = 254
_SATURATED_SHARE = 0.5
"""Of the points of a stripe. On a glossy surface a fifth is nothing unusual."""
_MM = 1e3


class StripeHint:
    """Watches the scans of one scanner; those that see nothing it looks at more widely.

    Args:
        calibration: camera and laser plane.
        config: see :class:`StripeConfig`.
        along_columns: as in :class:`Triangulator`.
    """

    def __init__(self, calibration: Calibration, config: StripeConfig, along_columns: bool) -> None:
        if calibration.laser is None:
            raise ValueError("a stripe needs a laser")
        self._range_m = calibration.laser.range_m
        wide = replace(calibration.laser, range_m=(self._range_m[0] / _BEYOND, self._range_m[1] * _BEYOND))
        self._calibration = replace(calibration, laser=wide)
        self._config, self._along_columns = config, along_columns
        self._wide: tuple[CentreOfMassDetector, Triangulator] | None = None
        self._empty: deque[bool] = deque(maxlen=_SCANS)
        self._saturated: deque[float] = deque(maxlen=_SCANS)
        self._depths_m: deque[float] = deque(maxlen=_SCANS // _LOOK_EVERY)

    def add(self, pixels: ByteArray, scan: LaserScan) -> None:
        """Take a short frame and what was seen in it."""
        self._empty.append(len(scan) == 0)
        if len(scan):
            self._saturated.append(_saturated_share(pixels, scan))
            self._depths_m.clear()
        elif self._empty.count(True) % _LOOK_EVERY == 0:
            self._look(pixels)

    @property
    def text(self) -> str:
        """What is wrong and what to do; empty where nothing is, or nothing is known."""
        if self._depths_m and sum(self._empty) > _SCANS // 2:
            depth_mm, (near_mm, far_mm) = _MM * float(np.median(self._depths_m)), (_MM * limit for limit in self._range_m)
            if depth_mm > far_mm:
                return f"too far: {depth_mm:.0f} mm, the laser's range ends at {far_mm:.0f} mm: move closer"
            if depth_mm < near_mm:
                return f"too near: {depth_mm:.0f} mm, the laser's range begins at {near_mm:.0f} mm: move away"
        if len(self._saturated) == _SCANS and (share := float(np.median(self._saturated))) > _SATURATED_SHARE:
            return f"stripe saturated, {100 * share:.0f} % of its points: shorten the short exposure, or dim the laser"
        return ""

    def _look(self, pixels: ByteArray) -> None:
        """Seek the stripe beyond the range, and remember how far it is."""
        if self._wide is None:
            band = search_band(self._calibration, self._along_columns, 0.0)
            triangulator = Triangulator(self._calibration, self._along_columns, 0.0)
            self._wide = CentreOfMassDetector(self._config, band), triangulator
        detector, triangulator = self._wide
        stripe = detector.detect(pixels)
        points, _, valid = triangulator.triangulate(stripe.pixels, stripe.sigma_px)
        if valid.any():
            self._depths_m.append(float(np.median(points[valid, 2])))


def _saturated_share(pixels: ByteArray, scan: LaserScan) -> float:
    """Return the share of a stripe's points where the brightest channel has reached its end."""
    columns, rows = np.rint(scan.pixels).astype(np.int64).T
    values = pixels[rows, columns]
    brightest = values if values.ndim == 1 else values.max(axis=1)
    return float((brightest >= _SATURATED).mean())
