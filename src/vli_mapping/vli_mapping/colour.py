"""Colour of stripe points: looked up in the long images before and after the scan, averaged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from vli_common.arrays import ByteArray, Float32Array, FloatArray
from vli_common.camera import CameraModel
from vli_common.geometry import inverse, transform


def colour_points(camera: CameraModel, points: FloatArray, views: Sequence[tuple[ByteArray, FloatArray]]) -> Float32Array:
    """Return RGB (N, 3), 0 … 255, the mean over the views that show a point; NaN where none does.

    Args:
        camera: of all views.
        points: (N, 3) in some frame w.
        views: pixels (H, W, 3) BGR or (H, W) grey, and ``T_w_camera`` (4, 4), of each long image.
    """
    total, count = np.zeros((len(points), 3), np.float32), np.zeros(len(points), np.float32)
    for pixels, T_w_camera in views:
        where = camera.project(transform(inverse(T_w_camera), points))
        _add_samples(pixels if pixels.ndim == 3 else pixels[:, :, None], where, total, count)
    with np.errstate(invalid="ignore"):
        result: Float32Array = total / count[:, None]
    return result


@njit(cache=True, nogil=True)
def _add_samples(pixels, where, total, count):  # type: ignore[no-untyped-def]
    """Add bilinear samples of BGR or grey (H, W, C) at pixels (N, 2) to RGB sums (N, 3); skip what lies outside."""
    height, width, channels = pixels.shape
    for index in range(len(where)):
        u, v = where[index]
        # Written so that NaN fails.
        if not (u >= 0 and v >= 0 and u <= width - 1 and v <= height - 1):
            continue
        column, row = min(int(u), width - 2), min(int(v), height - 2)
        a, b = u - column, v - row
        for channel in range(3):
            source = 2 - channel if channels == 3 else 0
            top = (1 - a) * pixels[row, column, source] + a * pixels[row, column + 1, source]
            bottom = (1 - a) * pixels[row + 1, column, source] + a * pixels[row + 1, column + 1, source]
            total[index, channel] += (1 - b) * top + b * bottom
        count[index] += 1
