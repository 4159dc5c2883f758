"""Colour of stripe points: looked up in the long images before and after the scan; and the light, from those farther off."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from vli_common.arrays import BoolArray, ByteArray, Float32Array, FloatArray
from vli_common.camera import CameraModel
from vli_common.geometry import inverse, transform
from vli_mapping.light import Sightings

SATURATED = 250
"""Grey level from which on a channel says only how much light there was at least."""
_DARKEST = 8
_HIDING_M, _HIDING_PX = 1.0e-3, 2.0
"""A point this much nearer in the same cell of so many pixels hides another; a flank seen at 80 degrees is no deeper there."""
_MOST_CELLS = 1 << 22
_MIN_FACING = 0.35
"""Cosine between normal and viewing ray of a spot that tells of the light: only where little falls is it seen what is ambient."""
_SHARPENING = 1.0
"""Times what a 3×3 binomial takes away: demosaicing and motion blur a print about that much."""


def colour_points(
    camera: CameraModel,
    points: FloatArray,
    views: Sequence[tuple[ByteArray, FloatArray]],
    beside: FloatArray | None = None,
) -> Float32Array:
    """Return RGB (N, 3), 0 … 255, the mean over the views that show a point; NaN where none does.

    A sample that is saturated, or where something nearer is in front of the point, counts only where there is no other.

    Args:
        camera: of all views.
        points: (N, 3) in some frame w, in order along a stripe.
        views: pixels (H, W, 3) BGR or (H, W) grey, and ``T_w_camera`` (4, 4), of each long image.
        beside: (M, 3) in w, more of the surface, that may be in front of the points as they themselves may.
    """
    total, weight = np.zeros((len(points), 3), np.float32), np.zeros(len(points), np.float32)
    surface = points if beside is None or not len(beside) else np.concatenate([points, beside])
    for pixels, T_w_camera in views:
        local = transform(inverse(T_w_camera), surface)
        where, hidden = camera.project(local), np.empty(len(points), np.bool_)
        _mark_hidden(where, local, _HIDING_M, hidden)
        _add_samples(pixels if pixels.ndim == 3 else pixels[:, :, None], where[: len(points)], hidden, total, weight)
    with np.errstate(invalid="ignore"):
        result: Float32Array = total / weight[:, None]
    return result


def sample_colours(camera: CameraModel, local: FloatArray, pixels: ByteArray) -> tuple[Float32Array, BoolArray]:
    """Return RGB (N, 3), 0 … 255, of points (N, 3) in the camera frame, and which of them (N,) an image shows, well exposed.

    Args:
        camera: of the image.
        local: all of the surface in its view, any of which may be in front of any other.
        pixels: (H, W, 3) BGR or (H, W) grey.
    """
    where, hidden = camera.project(local), np.empty(len(local), np.bool_)
    _mark_hidden(where, local, _HIDING_M, hidden)
    total, weight = np.zeros((len(local), 3), np.float32), np.zeros(len(local), np.float32)
    _add_samples(pixels if pixels.ndim == 3 else pixels[:, :, None], where, hidden, total, weight)
    return total, weight == 1.0


def sight(
    camera: CameraModel, points: FloatArray, normals: Float32Array, views: Sequence[tuple[ByteArray, FloatArray]]
) -> Sightings:
    """Return how the views show spots of a surface, those seen at least twice, well exposed and not grazing.

    Args:
        camera: of all views.
        points: (N, 3) in some frame w.
        normals: (N, 3) float32 in w, 0 = none.
        views: as of :func:`colour_points`.
    """
    level = np.full((len(points), len(views)), np.nan)
    local, turned = np.empty((len(points), len(views), 3)), np.empty((len(points), len(views), 3))
    for column, (pixels, T_w_camera) in enumerate(views):
        local[:, column] = transform(inverse(T_w_camera), points)
        turned[:, column] = normals @ T_w_camera[:3, :3]
        level[:, column] = colour_points(camera, points, [(pixels, T_w_camera)]).mean(axis=1)
    facing = -np.einsum("nvi,nvi->nv", local, turned) / np.linalg.norm(local, axis=2)
    good = (level > _DARKEST) & (level < SATURATED) & (facing > _MIN_FACING)
    good &= (good.sum(axis=1) >= 2)[:, None]
    return Sightings(np.nonzero(good)[0], level[good], local[good], turned[good])


@njit(cache=True, nogil=True)
def _mark_hidden(where, local, margin, hidden):  # type: ignore[no-untyped-def]
    """Say which of the first N of M points have another of them in front, nearer by ``margin`` and in the same few pixels.

    Args:
        where: (M, 2) pixels.
        local: (M, 3), camera frame.
        margin: metres along the axis.
        hidden: (N,), the answer.
    """
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for index in range(len(where)):
        for axis in range(2):
            # Written so that NaN is left out.
            if where[index, axis] < low[axis]:
                low[axis] = where[index, axis]
            if where[index, axis] > high[axis]:
                high[axis] = where[index, axis]
    hidden[:] = False
    cells = np.floor((high - low) / _HIDING_PX) + 1
    if not (0 < cells[0] * cells[1] < _MOST_CELLS):
        return
    nearest = np.full((int(cells[1]), int(cells[0])), np.inf)
    for index in range(len(where)):
        if where[index, 0] >= low[0] and where[index, 1] >= low[1] and local[index, 2] > 0:
            i, j = int((where[index, 1] - low[1]) / _HIDING_PX), int((where[index, 0] - low[0]) / _HIDING_PX)
            nearest[i, j] = min(nearest[i, j], local[index, 2])
    for index in range(len(hidden)):
        if where[index, 0] >= low[0] and where[index, 1] >= low[1]:
            i, j = int((where[index, 1] - low[1]) / _HIDING_PX), int((where[index, 0] - low[0]) / _HIDING_PX)
            hidden[index] = nearest[i, j] < local[index, 2] - margin


@njit(cache=True, nogil=True)
def _add_samples(pixels, where, hidden, total, weight):  # type: ignore[no-untyped-def]
    """Add sharpened bilinear samples of BGR or grey (H, W, C) at pixels (N, 2) to RGB sums (N, 3); skip what lies outside."""
    height, width, channels = pixels.shape
    sample = np.empty(3)
    for index in range(len(where)):
        u, v = where[index]
        # Written so that NaN fails.
        if not (u >= 0 and v >= 0 and u <= width - 1 and v <= height - 1):
            continue
        share = np.float32(1e-3) if hidden[index] else np.float32(1.0)
        for channel in range(3):
            source = 2 - channel if channels == 3 else 0
            sample[channel] = _sharp_sample(pixels, u, v, source)
            if sample[channel] >= SATURATED:
                share = np.float32(1e-3)
        for channel in range(3):
            total[index, channel] += share * np.float32(sample[channel])
        weight[index] += share


@njit(cache=True, nogil=True)
def _sharp_sample(pixels, u, v, channel):  # type: ignore[no-untyped-def]
    """Return the bilinear sample at (u, v) plus ``_SHARPENING`` times its difference to the binomial mean around it."""
    height, width = pixels.shape[:2]
    column, row = min(int(u), width - 2), min(int(v), height - 2)
    a, b = u - column, v - row
    if column < 1 or row < 1 or column > width - 3 or row > height - 3:
        top = (1 - a) * pixels[row, column, channel] + a * pixels[row, column + 1, channel]
        bottom = (1 - a) * pixels[row + 1, column, channel] + a * pixels[row + 1, column + 1, channel]
        return (1 - b) * top + b * bottom
    # The bilinear weights over four pixels an axis, and the same convolved with (1, 2, 1) / 4.
    across = ((0.0, 1 - a, a, 0.0), ((1 - a) / 4, (2 - a) / 4, (1 + a) / 4, a / 4))
    down = ((0.0, 1 - b, b, 0.0), ((1 - b) / 4, (2 - b) / 4, (1 + b) / 4, b / 4))
    sharp = soft = 0.0
    for j in range(4):
        for i in range(4):
            value = np.float64(pixels[row - 1 + j, column - 1 + i, channel])
            sharp += down[0][j] * across[0][i] * value
            soft += down[1][j] * across[1][i] * value
    return min(max(sharp + _SHARPENING * (sharp - soft), 0.0), 255.0)
