"""Has the laser plane moved since it was calibrated? Three signs of it, none of which the map would show by itself.

A plane that is off by δn and δd puts an error into the inverse depth that is linear in the ray, e = c · (x, y, 1). What of it
varies along the stripe, or with range, contradicts the structure that vision sees of the same landmarks
(:mod:`vli_backend.plane_residuals`). What does not is a scale, which only the IMU contradicts
(:mod:`vli_backend.inertial_scale`): weakly, but over a whole scan.

On the stripe the plane ties the ray across it, y, to the depth: y is affine in 1/z. So a tilt about the stripe's own axis,
δρ ∝ y, is a scale and a part of the relative error that is proportional to z: at 30 mm and a baseline of 15 mm, 0.5° is 2 % at
twice the range. A tilt along the stripe, δρ ∝ x, varies along it: 0.3° is 1 % per unit of x/z.

What cannot be known: a shift of the plane, δρ ∝ 1/z, is a scale and nothing else; seen at one range only, so is a tilt about the
stripe. The IMU tells a scale to a percent or two, no better.
"""

from __future__ import annotations

import numpy as np

from vli_backend.plane_residuals import PlaneResiduals
from vli_common.arrays import FloatArray
from vli_common.calibration import LaserCalibration

_MEMORY = 1500
"""Landmarks."""
_LEAST_LANDMARKS = 200
_ALONG_LIMIT, _RANGE_LIMIT, _SCALE_LIMIT = 0.003, 0.010, 0.025
"""Relative depth errors that are no accident: along the stripe, per unit of x/z; with range, per doubling; as a whole."""
_BETTER_HALF = 0.5
"""Share of the landmarks that are compared, those that vision knows best. A feature at a depth edge, where the laser measures
one side and the patch the other, betrays itself by the residual of its patch: with all of them, a true plane seems to be 1.4 %
off at twice the range on stepped scenes, with the better half 0.5 % at most."""
_CERTAIN = 5.0
_CERTAIN_SCALE = 4.0
_PLAUSIBLE_SCALE = 0.3
"""A path that seems to be more than so much longer or shorter tells of a motion too even for the IMU, not of the plane: one that
has moved that far betrays itself by the structure."""
_SCALE_FLOOR = 0.003
"""Of a relative scale: what a whole scan leaves open, however long."""
_CAUCHY = 2.0
_ADVICE = "laser plane may have moved: {}; re-run 'vli calibrate check'"


class LaserPlaneMonitor:
    """Keeps the newest residuals and says when they contradict the calibration.

    Args:
        laser: of the calibration.
    """

    def __init__(self, laser: LaserCalibration) -> None:
        across = laser.normal[:2] / max(float(np.linalg.norm(laser.normal[:2])), 1e-9)
        self._along = np.array([-across[1], across[0]])
        self._rows = np.empty((0, 5))
        self._weight, self._weighted = 0.0, 0.0
        self._problem = ""

    @property
    def hint(self) -> str:
        """What is wrong and what to do, in words; empty where nothing is."""
        return _ADVICE.format(self._problem) if self._problem else ""

    def add_residuals(self, found: PlaneResiduals) -> None:
        """Take the laser depths of landmarks that leave the window."""
        doubt = found.vision_sigma / found.vision
        rows = np.column_stack([found.rays @ self._along, 1.0 / found.fused, found.error, found.sigma, doubt])
        self._rows = np.concatenate([self._rows, rows[np.isfinite(rows).all(axis=1)]])[-_MEMORY:]
        if len(self._rows) >= _LEAST_LANDMARKS:
            self._judge()

    def add_scale(self, scale: float, sigma: float) -> None:
        """Take how long a piece of path is by the IMU over how long it is by the laser, and its relative sigma."""
        if abs(scale - 1.0) > _PLAUSIBLE_SCALE:
            return
        weight = 1.0 / sigma**2
        self._weight, self._weighted = self._weight + weight, self._weighted + weight * (scale - 1.0)
        self._judge()

    def _judge(self) -> None:
        self._problem = self._structure_problem() or self._scale_problem()

    def _structure_problem(self) -> str:
        if len(self._rows) < _LEAST_LANDMARKS:
            return ""
        doubt = self._rows[:, 4]
        along, depth, error, sigma = self._rows[doubt <= np.quantile(doubt, _BETTER_HALF), :4].T
        middle = float(np.median(depth))
        slopes, spread = _robust_slopes(np.column_stack([along, depth / middle - 1.0, np.ones(len(along))]), error, sigma)
        if abs(slopes[0]) > max(_ALONG_LIMIT, _CERTAIN * spread[0]):
            return f"its depths change by {100 * slopes[0]:+.1f} % along the stripe against what vision sees"
        if abs(slopes[1]) > max(_RANGE_LIMIT, _CERTAIN * spread[1]):
            return f"its depths are {100 * slopes[1]:+.1f} % off at twice the range against what vision sees"
        return ""

    def _scale_problem(self) -> str:
        if self._weight == 0.0:
            return ""
        mean, sigma = self._weighted / self._weight, float(np.hypot(self._weight**-0.5, _SCALE_FLOOR))
        if abs(mean) < max(_SCALE_LIMIT, _CERTAIN_SCALE * sigma):
            return ""
        return f"the IMU says that the path is {100 * mean:+.1f} % (±{100 * sigma:.1f} %) longer than by the laser"


def _robust_slopes(columns: FloatArray, error: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients of a robust fit (3,) and their standard deviations (3,); error and sigma are (N,)."""
    weight = 1.0 / sigma**2
    for _ in range(5):
        normal = (columns * weight[:, None]).T @ columns
        solution = np.linalg.solve(normal, columns.T @ (weight * error))
        residual = (error - columns @ solution) / sigma
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-6)
        weight = 1.0 / sigma**2 / (1.0 + (residual / (_CAUCHY * scale)) ** 2)
    spread: FloatArray = scale * np.sqrt(np.diag(np.linalg.inv(normal)))
    found: FloatArray = solution.astype(np.float64)
    return found, spread
