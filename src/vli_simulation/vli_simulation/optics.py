"""The lens and the exposure: rays of all pixels, vignetting, defocus, and motion blur along the true image motion."""

from __future__ import annotations

import cv2
import numba
import numpy as np

from vli_common.arrays import Float32Array, FloatArray
from vli_common.camera import CameraModel
from vli_simulation.texture import FAST

SUBPIXELS = ((-0.3, 0.16), (0.3, -0.16))
"""Rays per pixel where one is not enough: not in one row or column, their mean is the pixel's centre."""
_DEFOCUS_PX = 0.5
_MIN_SMEAR_PX = 0.08
DIM_STEP = 3
"""Pixels from ray to ray of the dim grid."""


class Lens:
    """What follows from the lens alone. Rays are (x/z, y/z, 1) in the camera frame; images are (H, W), flat where noted."""

    def __init__(self, camera: CameraModel, vignetting: float) -> None:
        self.height, self.width = camera.height, camera.width
        u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
        pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
        flat = camera.unproject(pixels)
        self.rays = _with_depth(flat)
        """(H·W, 3) of the pixel centres."""
        self.subrays = np.stack([_with_depth(camera.unproject(pixels + offset)) for offset in SUBPIXELS])
        """(2, H·W, 3), see ``SUBPIXELS``."""
        self.coarse_shape = camera.height // 2 + 1, camera.width // 2 + 1
        self.coarse_rays = _with_depth(camera.unproject(_grid_pixels(self.coarse_shape, 2)))
        """Of every second pixel, and one row and column beyond the image."""
        self.dim_shape = -(-camera.height // DIM_STEP) + 1, -(-camera.width // DIM_STEP) + 1
        self.dim_rays = _with_depth(camera.unproject(_grid_pixels(self.dim_shape, DIM_STEP)))
        """Of every third pixel, and one row and column beyond the image."""
        self._focal_px = camera.focal_px
        self._jacobian = self._jacobians(camera, flat)
        radius2 = ((u - camera.cx) ** 2 + (v - camera.cy) ** 2) / (0.25 * (camera.width**2 + camera.height**2))
        self.vignette = (1 - vignetting * (0.8 * radius2 + 0.2 * radius2**2)).clip(0.02).astype(np.float32)

    def enlarge(self, dim: Float32Array) -> Float32Array:
        """Return an image (h, w) or (h, w, C) on the dim grid at full resolution, bilinear."""
        matrix = np.array([[1 / DIM_STEP, 0, 0], [0, 1 / DIM_STEP, 0]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(dim, matrix, (self.width, self.height), flags=flags, borderMode=cv2.BORDER_REPLICATE))

    def expose(
        self, image: Float32Array, depth: Float32Array, velocity: FloatArray, rate: FloatArray, exposure_s: float, gain: float
    ) -> Float32Array:
        """Return the light on each pixel of an RGGB mosaic (H, W).

        Args:
            image: (H, W, 3) sharp radiance at mid-exposure, blue green red.
            depth: (H, W) along the axis, zero where nothing is seen.
            velocity, rate: (3,) of the camera in the camera frame.
            exposure_s: of the shutter.
            gain: grey levels of radiance 1 in the middle of the image.
        """
        soft: Float32Array = np.asarray(cv2.GaussianBlur(image, (0, 0), _DEFOCUS_PX), dtype=np.float32)
        seen = depth[depth > 0]
        nearest = float(seen.min()) if len(seen) else np.inf
        fastest = 1.5 * self._focal_px * float(np.linalg.norm(velocity) / nearest + 2.0 * np.linalg.norm(rate))
        if fastest * exposure_s < _MIN_SMEAR_PX:
            return _mosaic(soft) * (np.float32(gain) * self.vignette)
        out = np.empty(depth.shape, np.float32)
        _integrate(soft, depth, self.rays, self._jacobian, velocity, rate, exposure_s, _MIN_SMEAR_PX, gain, self.vignette, out)
        return out

    def add_laser(self, stripe: Float32Array, response: FloatArray, gain: float, mosaic: Float32Array) -> None:
        """Add laser light (H, W) to the light on an RGGB mosaic (H, W); it travels with the camera, so that nothing smears it.

        Args:
            stripe: sharp light of the laser.
            response: (3,) of blue, green and red pixels to its colour.
            gain: grey levels of light 1 in the middle of the image.
            mosaic: changed in place.
        """
        soft = cv2.GaussianBlur(stripe, (0, 0), _DEFOCUS_PX) * self.vignette
        for row in range(2):
            for column in range(2):
                part = np.s_[row::2, column::2]
                mosaic[part] += np.float32(gain * response[2 - row - column]) * soft[part]

    def _jacobians(self, camera: CameraModel, rays: FloatArray) -> Float32Array:
        """Return the derivatives of pixels by rays (H·W, 4), row by row."""
        step = 1e-5
        columns = [
            (camera.to_pixels(rays + offset) - camera.to_pixels(rays - offset)) / (2 * step) for offset in step * np.eye(2)
        ]
        return np.stack(columns, axis=-1).reshape(-1, 4).astype(np.float32)


def _grid_pixels(shape: tuple[int, int], step: int) -> FloatArray:
    u, v = np.meshgrid(float(step) * np.arange(shape[1]), float(step) * np.arange(shape[0]))
    return np.stack([u, v], axis=-1).reshape(-1, 2)


def _mosaic(image: Float32Array) -> Float32Array:
    """Return the channel of (H, W, 3), blue green red, that each pixel of an RGGB mosaic has."""
    out = np.ascontiguousarray(image[..., 1])
    out[::2, ::2], out[1::2, 1::2] = image[::2, ::2, 2], image[1::2, 1::2, 0]
    return out


def _with_depth(rays: FloatArray) -> Float32Array:
    return np.column_stack([rays, np.ones(len(rays))]).astype(np.float32)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _integrate(
    image: Float32Array,
    depth: Float32Array,
    rays: Float32Array,
    jacobian: Float32Array,
    velocity: FloatArray,
    rate: FloatArray,
    exposure: float,
    threshold: float,
    gain: float,
    vignette: Float32Array,
    out: Float32Array,
) -> None:
    """Average the mosaic's channel of ``image`` along the image motion; a fixed point moves by −v − ω × X in the camera frame."""
    height, width = depth.shape
    for i in range(height):
        for j in range(width):
            n = i * width + j
            c = 2 - (i & 1) - (j & 1)
            x, y = rays[n, 0], rays[n, 1]
            inverse = 1.0 / depth[i, j] if depth[i, j] > 0.0 else 0.0
            vz = -velocity[2] * inverse - (rate[0] * y - rate[1] * x)
            dx = -velocity[0] * inverse - (rate[1] - rate[2] * y) - x * vz
            dy = -velocity[1] * inverse - (rate[2] * x - rate[0]) - y * vz
            du = exposure * (jacobian[n, 0] * dx + jacobian[n, 1] * dy)
            dv = exposure * (jacobian[n, 2] * dx + jacobian[n, 3] * dy)
            longest = max(abs(du), abs(dv))
            total = float(image[i, j, c])
            if longest > threshold:
                samples = min(max(int(3.0 * longest) + 1, 3), 32)
                total = 0.0
                for s in range(samples):
                    share = (s + 0.5) / samples - 0.5
                    p = min(max(j + share * du, 0.0), width - 1.001)
                    q = min(max(i + share * dv, 0.0), height - 1.001)
                    a, b = int(p), int(q)
                    p, q = p - a, q - b
                    top = image[b, a, c] + p * (image[b, a + 1, c] - image[b, a, c])
                    bottom = image[b + 1, a, c] + p * (image[b + 1, a + 1, c] - image[b + 1, a, c])
                    total += top + q * (bottom - top)
                total /= samples
            out[i, j] = total * gain * vignette[i, j]
