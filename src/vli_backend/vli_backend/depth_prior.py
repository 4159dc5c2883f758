"""What is known of depth before anything was measured: every default of the back end that is a distance follows from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vli_backend.config import BackEndConfig
from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration
from vli_common.types import LaserScan

_LASER_SPREAD = 0.5
_VISUAL_SPREAD = 3.0
_FIRST_SPREAD = 2.0
_ENOUGH = 5
"""Landmarks whose median says where others may be."""
_REACH = 8.0
"""Without any range given, depths may lie this factor around the median that a start from vision finds."""


@dataclass(frozen=True)
class DepthPrior:
    """Range of surfaces (m), a first depth (m), and one sigma of an inverse depth's first guess, relative.

    With the laser the guess is good and steadies a young landmark. Without it the guess is only what the window believes: it must
    say next to nothing, or hundreds of landmarks together hold a wrong scale. So must the first one of all, which is the same for
    all landmarks: it is the stripe's depth, and they may lie on something else.
    """

    near: float
    far: float
    first: float
    spread: float = _LASER_SPREAD
    first_spread: float = _FIRST_SPREAD

    @property
    def inverse_limits(self) -> tuple[float, float]:
        """The inverse depths (1/m) that a landmark may have: the range, generously."""
        return 0.3 / self.far, 3.0 / self.near

    @staticmethod
    def of_scene(calibration: Calibration, config: BackEndConfig) -> DepthPrior:
        """Return that of the scene's range: as configured, else the laser's, else that of a scanner."""
        near, far = calibration.laser.range_m if calibration.laser is not None else (0.02, 0.15)
        near, far = config.scene.near_m or near, config.scene.far_m or far
        return DepthPrior(near, far, (near * far) ** 0.5)

    def guess(self, scan: LaserScan | None, known: FloatArray) -> float:
        """Return a new landmark's inverse depth, 1/m: the median of the newest scan, else of landmarks (N,), else the prior's."""
        if scan is not None and len(scan):
            return float(1.0 / np.median(scan.points[:, 2]))
        return float(np.median(known)) if len(known) >= _ENOUGH else 1.0 / self.first

    def around(self, median: float) -> DepthPrior:
        """Return the prior of a start from vision, whose landmarks lie at a median depth."""
        return DepthPrior(min(self.near, median / _REACH), max(self.far, median * _REACH), median, _VISUAL_SPREAD, _VISUAL_SPREAD)
