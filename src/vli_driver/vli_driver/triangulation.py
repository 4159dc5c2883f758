"""Stripe pixels to points: the geometry of camera and laser plane, eq. (1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from vli_common.arrays import BoolArray, FloatArray, IntArray
from vli_common.calibration import Calibration, LaserCalibration
from vli_common.camera import CameraModel
from vli_common.errors import CalibrationError


@dataclass(frozen=True)
class SearchBand:
    """Where the stripe can be: for each profile (image column or row) the samples [first, last).

    Args:
        along_columns: True where a profile is an image column, so that the stripe runs roughly from left to right.
        first, last: (N,) int64.
    """

    along_columns: bool
    first: IntArray
    last: IntArray

    @property
    def start(self) -> int:
        """First sample of any profile."""
        seen = self.last > self.first
        return int(self.first[seen].min()) if seen.any() else 0

    @property
    def stop(self) -> int:
        """One past the last sample of any profile."""
        return int(self.last.max(initial=0))


def stripe_runs_across_columns(laser: LaserCalibration) -> bool:
    """Return True where the stripe on a surface parallel to the image is nearer to horizontal than to vertical."""
    return bool(abs(laser.normal[1]) >= abs(laser.normal[0]))


def search_band(calibration: Calibration, along_columns: bool, margin: float) -> SearchBand:
    """Return the part of the image where the laser plane lies within its range, widened by the share ``margin`` at either end.

    Raises:
        CalibrationError: the laser plane cannot be seen within its range.
    """
    laser = _laser(calibration)
    camera = calibration.camera
    depth = _plane_depth(camera, laser)
    near, far = laser.range_m[0] * (1 - margin), laser.range_m[1] * (1 + margin)
    with np.errstate(invalid="ignore"):
        inside = (depth >= near) & (depth <= far)
    profiles: BoolArray = inside.T if along_columns else inside
    if not profiles.any():
        raise CalibrationError(
            "laser0",
            [
                f"the laser plane is nowhere in the image at 'range_m' {list(laser.range_m)}; re-run 'vli "
                f"calibrate laser' or correct range_m"
            ],
        )
    seen = profiles.any(axis=1)
    first = np.where(seen, profiles.argmax(axis=1), 0)
    last = np.where(seen, profiles.shape[1] - profiles[:, ::-1].argmax(axis=1), 0)
    return SearchBand(along_columns, first.astype(np.int64), last.astype(np.int64))


def full_band(width: int, height: int, along_columns: bool) -> SearchBand:
    """Return the band that is the whole image, for a detector without a calibration."""
    count, samples = (width, height) if along_columns else (height, width)
    return SearchBand(along_columns, np.zeros(count, np.int64), np.full(count, samples, np.int64))


class Triangulator:
    """Intersects viewing rays with the laser plane, eq. (1): X = −d / (n · r) r.

    Rays come from a table of the undistorted ray of every pixel of the band; between pixels it is linear, which for a lens that a
    calibration can describe is exact to some 1e-4 px.

    Args:
        calibration: camera and laser plane.
        along_columns: True where the stripe's error is along the image columns.
        margin: share by which points may exceed the laser's range.
    """

    def __init__(self, calibration: Calibration, along_columns: bool, margin: float) -> None:
        laser = _laser(calibration)
        self._plane = np.array([*laser.normal, laser.d])
        self._range = np.array([laser.range_m[0] * (1 - margin), laser.range_m[1] * (1 + margin)])
        self._along = 1 if along_columns else 0
        self._rays = pixel_rays(calibration.camera)

    def triangulate(self, pixels: FloatArray, sigma_px: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return points (N, 3) in the camera frame, their sigma (N,) along the viewing ray, and which are within range (N,).

        Args:
            pixels: (N, 2) raw u, v.
            sigma_px: (N,) across the stripe.
        """
        points, sigma = np.empty((len(pixels), 3)), np.empty(len(pixels))
        valid = np.empty(len(pixels), np.bool_)
        _triangulate(pixels, sigma_px, self._rays, self._plane, self._range, self._along, points, sigma, valid)
        return points, sigma, valid


def pixel_rays(camera: CameraModel) -> FloatArray:
    """Return the undistorted ray (H, W, 2) of every pixel; NaN where the lens model has none."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
    rays = camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1))
    return rays.reshape(camera.height, camera.width, 2)


def _plane_depth(camera: CameraModel, laser: LaserCalibration) -> FloatArray:
    """Return the depth z (H, W) of the laser plane behind every pixel; negative or infinite where it is not in front."""
    rays = pixel_rays(camera)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth: FloatArray = -laser.d / (rays @ laser.normal[:2] + laser.normal[2])
    return depth


def _laser(calibration: Calibration) -> LaserCalibration:
    if calibration.laser is None:
        raise CalibrationError("laser0", ["section is missing, needed to triangulate; make it with 'vli calibrate laser'"])
    return calibration.laser


@njit(cache=True, nogil=True)
def _triangulate(pixels, sigma_px, rays, plane, limits, along, points, sigma, valid):  # type: ignore[no-untyped-def]
    height, width = rays.shape[:2]
    for i in range(len(pixels)):
        u, v = pixels[i]
        column, row = min(max(int(u), 0), width - 2), min(max(int(v), 0), height - 2)
        a, b = u - column, v - row
        x = np.empty(3)
        slope = np.zeros(3)
        x[2] = 1.0
        for k in range(2):
            top = (1 - a) * rays[row, column, k] + a * rays[row, column + 1, k]
            bottom = (1 - a) * rays[row + 1, column, k] + a * rays[row + 1, column + 1, k]
            x[k] = (1 - b) * top + b * bottom
            if along == 1:
                slope[k] = bottom - top
            else:
                slope[k] = (1 - b) * (rays[row, column + 1, k] - rays[row, column, k]) + b * (
                    rays[row + 1, column + 1, k] - rays[row + 1, column, k]
                )
        dot = plane[0] * x[0] + plane[1] * x[1] + plane[2]
        change = plane[0] * slope[0] + plane[1] * slope[1]
        z = -plane[3] / dot if dot != 0 else np.inf
        length = np.sqrt(x[0] ** 2 + x[1] ** 2 + 1)
        # Range ρ = z |r|; dρ/dp = z (r·r' / |r| − |r| n·r' / n·r).
        rate = z * ((x[0] * slope[0] + x[1] * slope[1]) / length - length * change / dot) if dot != 0 else np.inf
        for k in range(3):
            points[i, k] = z * x[k]
        sigma[i] = abs(rate) * sigma_px[i]
        valid[i] = limits[0] <= z <= limits[1] and np.isfinite(sigma[i])
