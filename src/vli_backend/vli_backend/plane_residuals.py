"""Laser depths against what vision alone says of the same landmarks: the evidence of a laser plane that has moved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vli_backend.condense import LandmarkArrays, refine
from vli_backend.landmarks import LandmarkTable
from vli_common.arrays import BoolArray, FloatArray

_MIN_OBSERVATIONS = 4


@dataclass(frozen=True)
class PlaneResiduals:
    """Laser depths of N landmarks, compared.

    Args:
        rays: (N, 2) where the laser measured them.
        laser, laser_sigma: (N,) inverse depth and its sigma by the laser, 1/m.
        vision, vision_sigma: (N,) the same by the other observations.
    """

    rays: FloatArray
    laser: FloatArray
    laser_sigma: FloatArray
    vision: FloatArray
    vision_sigma: FloatArray

    def __len__(self) -> int:
        return len(self.laser)

    @property
    def error(self) -> FloatArray:
        """Of the laser's depth against vision's (N,), relative: positive where the laser says farther."""
        result: FloatArray = (self.vision - self.laser) / self.fused
        return result

    @property
    def sigma(self) -> FloatArray:
        """Of :attr:`error` (N,)."""
        result: FloatArray = np.hypot(self.laser_sigma, self.vision_sigma) / self.fused
        return result

    @property
    def fused(self) -> FloatArray:
        """The inverse depth (N,) that both give together, 1/m.

        Its error is not correlated with that of the difference, which the error of either alone is: against such a depth noise
        would look like an error that changes with range.
        """
        weight, other = self.laser_sigma**-2, self.vision_sigma**-2
        result: FloatArray = (weight * self.laser + other * self.vision) / (weight + other)
        return result


def plane_residuals(
    table: LandmarkTable, rows: BoolArray, T_map_camera: FloatArray, cauchy: float, limits: tuple[float, float]
) -> PlaneResiduals:
    """Return the laser depths of landmarks less those that their other observations give, poses fixed.

    Args:
        table: of the window; not changed.
        rows: (L,) the landmarks to compare; those without a laser depth or with few observations are left out.
        T_map_camera: (K, 4, 4) of the window.
        cauchy: robust loss, sigmas.
        limits: of inverse depths, 1/m.
    """
    chosen = np.flatnonzero(rows & (table.observations >= _MIN_OBSERVATIONS) & (table.arrays.depth_sigma > 0).any(axis=1))
    arrays = table.arrays
    slot = np.argmax(arrays.depth_sigma[chosen] > 0, axis=1)
    measured, sigma = arrays.depth[chosen, slot], arrays.depth_sigma[chosen, slot]
    blind = LandmarkArrays(
        arrays.anchor[chosen],
        arrays.anchor_ray[chosen],
        arrays.rho[chosen].copy(),
        arrays.prior[chosen],
        arrays.rays[chosen],
        arrays.seen[chosen],
        arrays.whitening[chosen],
        arrays.depth[chosen],
        np.zeros_like(arrays.depth_sigma[chosen]),
    )
    information = refine(blind, T_map_camera, np.ones(len(chosen), np.bool_), cauchy, limits)
    rays = np.column_stack([blind.anchor_ray, np.ones(len(chosen))]) / blind.rho[:, None]
    anchor, primary = T_map_camera[blind.anchor], T_map_camera[slot]
    in_map = np.einsum("nij,nj->ni", anchor[:, :3, :3], rays) + anchor[:, :3, 3]
    seen = np.einsum("nji,nj->ni", primary[:, :3, :3], in_map - primary[:, :3, 3])
    return PlaneResiduals(seen[:, :2] / seen[:, 2:], measured, sigma, 1.0 / seen[:, 2], information**-0.5)
