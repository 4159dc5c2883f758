"""Camera models: pixels ⇄ rays, vectorised.

Pixel (0, 0) is the centre of the top-left pixel (OpenCV's convention). A *ray* is the undistorted normalised direction
(x/z, y/z), so a point is ``z · (ray, 1)``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numba
import numpy as np

from vli_common.arrays import FloatArray

_ITERATIONS = 20
_CONVERGED = 1e-12
_STEP = 1e-6
"""Of derivatives by differences, normalised."""
_STEPS = _STEP * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


@dataclass(frozen=True)
class CameraModel(ABC):
    """A pinhole camera with lens distortion.

    Args:
        fx, fy, cx, cy: pixels.
        coefficients: of the distortion, order as in the calibration file.
        width, height: pixels.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    coefficients: tuple[float, ...]
    width: int
    height: int

    @abstractmethod
    def distort(self, rays: FloatArray) -> FloatArray:
        """Return distorted normalised coordinates (N, 2) of undistorted ones (N, 2)."""

    @abstractmethod
    def undistort(self, distorted: FloatArray) -> FloatArray:
        """Return undistorted normalised coordinates (N, 2) of distorted ones (N, 2)."""

    def project(self, points: FloatArray) -> FloatArray:
        """Return raw pixels (N, 2) of points (N, 3) in the camera frame; NaN for z ≤ 0."""
        z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
        return self.to_pixels(points[:, :2] / z[:, None])

    def to_pixels(self, rays: FloatArray) -> FloatArray:
        """Return raw pixels (N, 2) of rays (N, 2)."""
        result: FloatArray = self.distort(rays) * [self.fx, self.fy] + [self.cx, self.cy]
        return result

    def unproject(self, pixels: FloatArray) -> FloatArray:
        """Return rays (N, 2) of raw pixels (N, 2)."""
        return self.undistort((np.asarray(pixels, dtype=np.float64) - [self.cx, self.cy]) / [self.fx, self.fy])

    def pixel_grid(self, steps: int = 25) -> FloatArray:
        """Return pixels (steps², 2) spread evenly over the image, edges and corners included."""
        u, v = np.linspace(-0.5, self.width - 0.5, steps), np.linspace(-0.5, self.height - 0.5, steps)
        return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)

    def is_invertible(self) -> bool:
        """Return True where every pixel of the image has one ray: the distortion never folds between it and the centre."""
        pixels = self.pixel_grid()
        with np.errstate(all="ignore"):
            rays = self.unproject(pixels)
            residual = np.abs(self.to_pixels(rays) - pixels).max()
            # Newton may land beyond a fold, where the round trip closes too; hence the walk from the centre.
            walk = (np.linspace(0.02, 1.0, 50)[:, None, None] * rays).reshape(-1, 2)
            determinant = np.linalg.det(self.jacobian(walk))
        return bool(np.isfinite(residual) and residual < 1e-6 and (determinant > 0).all())

    def jacobian(self, rays: FloatArray) -> FloatArray:
        """Return d pixel / d ray (N, 2, 2) at rays (N, 2), by central differences.

        It is far from f·I where a lens bends much: 60° off the axis of a fisheye a pixel is four times as long on the plane of
        rays as in the middle, radially, and 1.7 times tangentially.
        """
        pixels = self.to_pixels((rays + _STEPS[:, None]).reshape(-1, 2)).reshape(4, -1, 2)
        result: FloatArray = np.stack([pixels[0] - pixels[1], pixels[2] - pixels[3]], axis=2) / (2 * _STEP)
        return result

    @property
    def focal_px(self) -> float:
        """Geometric mean of fx and fy."""
        return float(np.sqrt(self.fx * self.fy))

    @property
    def matrix(self) -> FloatArray:
        """The (3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])


class RadtanCamera(CameraModel):
    """Radial-tangential distortion k1 k2 p1 p2 [k3] (Brown–Conrady, as OpenCV); four zeros: no distortion."""

    def _parameters(self) -> tuple[float, float, float, float, float]:
        k1, k2, p1, p2, *rest = self.coefficients
        return k1, k2, p1, p2, rest[0] if rest else 0.0

    def distort(self, rays: FloatArray) -> FloatArray:
        """See :meth:`CameraModel.distort`."""
        distorted: FloatArray = _distort_radtan(np.ascontiguousarray(rays, dtype=np.float64), *self._parameters())
        return distorted

    def undistort(self, distorted: FloatArray) -> FloatArray:
        """See :meth:`CameraModel.undistort`; Newton's method with the exact Jacobian."""
        distorted = np.ascontiguousarray(distorted, dtype=np.float64)
        rays: FloatArray = _undistort_radtan(distorted, *self._parameters())
        return rays


@numba.njit(cache=True, nogil=True)
def _distort_radtan(rays, k1, k2, p1, p2, k3):  # type: ignore[no-untyped-def]
    """In numba since a frame asks a dozen times for a hundred points, each of which costs numpy twenty small calls."""
    out = np.empty(rays.shape)
    for i in range(len(rays)):
        x, y = rays[i, 0], rays[i, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        out[i, 0] = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        out[i, 1] = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return out


@numba.njit(cache=True, nogil=True)
def _undistort_radtan(distorted, k1, k2, p1, p2, k3):  # type: ignore[no-untyped-def]
    """Newton's method, point by point; in numba since every feature and every calibration of the stripe passes here."""
    rays = distorted.copy()
    for i in range(len(distorted)):
        x, y = distorted[i, 0], distorted[i, 1]
        for _ in range(_ITERATIONS):
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
            error_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - distorted[i, 0]
            error_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - distorted[i, 1]
            jxx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
            jxy = x * y * slope + 2 * p1 * x + 2 * p2 * y
            jyy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
            det = jxx * jyy - jxy * jxy
            step_x, step_y = (jyy * error_x - jxy * error_y) / det, (jxx * error_y - jxy * error_x) / det
            x, y = x - step_x, y - step_y
            if not abs(step_x) + abs(step_y) > _CONVERGED:
                break
        rays[i, 0], rays[i, 1] = x, y
    return rays


class EquidistantCamera(CameraModel):
    """Kannala–Brandt fisheye k1 k2 k3 k4: θ_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)."""

    def distort(self, rays: FloatArray) -> FloatArray:
        """See :meth:`CameraModel.distort`."""
        k1, k2, k3, k4 = self.coefficients
        r = np.hypot(rays[:, 0], rays[:, 1])
        theta = np.arctan(r)
        t2 = theta * theta
        theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        result: FloatArray = rays * np.where(r > 1e-12, theta_d / np.maximum(r, 1e-12), 1.0)[:, None]
        return result

    def undistort(self, distorted: FloatArray) -> FloatArray:
        """See :meth:`CameraModel.undistort`; NaN beyond 90° off the axis."""
        k1, k2, k3, k4 = self.coefficients
        theta_d = np.hypot(distorted[:, 0], distorted[:, 1])
        theta = np.minimum(theta_d, np.pi / 2)
        for _ in range(_ITERATIONS):
            t2 = theta * theta
            error = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - theta_d
            step = error / (1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4))))
            theta = theta - step
            if not np.abs(step).max(initial=0.0) > _CONVERGED:
                break
        radius = np.where(np.abs(theta) < np.pi / 2, np.tan(theta), np.nan)
        result: FloatArray = distorted * np.where(theta_d > 1e-12, radius / np.maximum(theta_d, 1e-12), 1.0)[:, None]
        return result


MODELS: dict[str, tuple[type[CameraModel], tuple[int, ...]]] = {
    "radtan": (RadtanCamera, (4, 5)),
    "equidistant": (EquidistantCamera, (4,)),
    "none": (RadtanCamera, (0, 4)),
}
"""Distortion model name → class and valid numbers of coefficients."""


def make_camera(
    model: str, intrinsics: tuple[float, ...], coefficients: tuple[float, ...], resolution: tuple[int, int]
) -> CameraModel:
    """Return the camera of a (validated) calibration; a model ``none`` has zero distortion."""
    fx, fy, cx, cy = intrinsics
    if model == "none":
        coefficients = (0.0, 0.0, 0.0, 0.0)
    return MODELS[model][0](fx, fy, cx, cy, tuple(coefficients), *resolution)
