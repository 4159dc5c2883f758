"""Choice of new points: Shi–Tomasi corners, spread evenly over the image."""

from __future__ import annotations

from typing import cast

import cv2
import numpy as np
from numba import njit

from vli_common.arrays import ByteArray, Float32Array, FloatArray, IntArray
from vli_frontend.config import DetectionConfig
from vli_frontend.patch_alignment import MARGIN_PX

_BLOCK = 3
_NEIGHBOURS = np.ones((3, 3), np.uint8)
_NOISE_RESPONSE = 4e-5
"""Corner response of sensor noise on an empty area (OpenCV's scale, half-size image): nothing below is a corner."""


def detect(half: ByteArray, existing: FloatArray, count: int, config: DetectionConfig) -> FloatArray:
    """Return new corners (M, 2), full-size pixels, at least ``distance_px`` from each other and from ``existing``.

    The response (least eigenvalue of the structure tensor, Shi and Tomasi, 1994) is taken at half the size, which costs a tenth;
    the cells of a grid fill up evenly, each from its strongest corner down.

    Args:
        half: (H/2, W/2) uint8, see ``photometry.Frame``.
        existing: (N, 2) pixels of the full size.
        count: most points wanted.
        config: quality, distance, grid.
    """
    if count <= 0:
        return np.empty((0, 2))
    response = cast(Float32Array, cv2.cornerMinEigenVal(half, _BLOCK))
    _clear_border(response, (MARGIN_PX + 2) // 2)
    peaks = _peaks(response, max(config.quality * float(response.max()), _NOISE_RESPONSE))
    chosen: FloatArray = _choose(response, peaks, existing / 2, count, config.distance_px / 2, config.cells)
    return 2.0 * chosen


def _clear_border(response: Float32Array, margin: int) -> None:
    response[:margin] = response[-margin:] = 0.0
    response[:, :margin] = response[:, -margin:] = 0.0


def _peaks(response: Float32Array, threshold: float) -> IntArray:
    """Return (M, 2) row and column of the local maxima above the threshold, strongest first."""
    maximal = (response >= cv2.dilate(response, _NEIGHBOURS)) & (response > threshold)
    rows, columns = np.nonzero(maximal)
    order = np.argsort(-response[rows, columns], kind="stable")
    return np.stack([rows[order], columns[order]], axis=1).astype(np.int64)


@njit(cache=True, nogil=True)
def _choose(response: Float32Array, peaks: IntArray, existing: FloatArray, count: int, distance: float, cells: int) -> FloatArray:
    """Return up to ``count`` points (M, 2), x and y; rounds over the grid raise the number of points a cell may hold by one."""
    height, width = response.shape
    size = max(1.0, width / cells)
    columns, rows = int(np.ceil(width / size)), int(np.ceil(height / size))
    held = np.zeros((rows, columns), np.int64)
    points = np.empty((len(existing) + count, 2))
    points[: len(existing)] = existing
    for n in range(len(existing)):
        held[_cell(existing[n, 1], size, rows), _cell(existing[n, 0], size, columns)] += 1
    free = np.ones(len(peaks), np.bool_)
    used, quota = len(existing), 1
    while used < len(points) and free.any():
        for n in range(len(peaks)):
            y, x = float(peaks[n, 0]), float(peaks[n, 1])
            row, column = _cell(y, size, rows), _cell(x, size, columns)
            if not free[n] or held[row, column] >= quota:
                continue
            free[n] = False
            if used < len(points) and _is_clear(points[:used], x, y, distance):
                points[used, 0], points[used, 1] = x, y
                used += 1
                held[row, column] += 1
        quota += 1
    return points[len(existing) : used]


@njit(cache=True, nogil=True)
def _cell(coordinate: float, size: float, cells: int) -> int:
    return min(max(int(coordinate / size), 0), cells - 1)


@njit(cache=True, nogil=True)
def _is_clear(points: FloatArray, x: float, y: float, distance: float) -> bool:
    nearest = np.inf
    for n in range(len(points)):
        nearest = min(nearest, (points[n, 0] - x) ** 2 + (points[n, 1] - y) ** 2)
    return nearest >= distance * distance
