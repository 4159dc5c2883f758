"""What a map is coloured by."""

from __future__ import annotations

from collections.abc import Callable

import matplotlib
import numpy as np

from vli_common.arrays import AnyArray, ByteArray, Float32Array
from vli_common.types import PointCloud

_GREY = 128
_RANGE_PERCENT = 2, 98
"""What lies beyond has the colour of the end: a few stray points are not to take all contrast from the others."""


def as_scanned(cloud: PointCloud) -> ByteArray:
    """Return the colours (N, 3) of the points themselves."""
    return cloud.colours


def by_normal(cloud: PointCloud) -> ByteArray:
    """Return colours (N, 3) whose red, green and blue are the parts of the normal along x, y and z; grey: there is none."""
    if cloud.normals is None:
        return np.full((len(cloud), 3), _GREY, np.uint8)
    colours: ByteArray = np.rint(127.5 * (1 + np.clip(cloud.normals, -1, 1))).astype(np.uint8)
    colours[~cloud.normals.any(axis=1)] = _GREY
    return colours


def by_weight(cloud: PointCloud) -> ByteArray:
    """Return colours (N, 3) from dark, seen once, to bright, merged often; in steps of a factor."""
    if cloud.weights is None:
        return np.full((len(cloud), 3), _GREY, np.uint8)
    return _scale(np.log(np.maximum(cloud.weights, 1.0)))


def by_height(cloud: PointCloud) -> ByteArray:
    """Return colours (N, 3) from dark, low, to bright, high, along gravity."""
    return _scale(cloud.points[:, 2])


COLOURINGS: dict[str, Callable[[PointCloud], ByteArray]] = {
    "colour": as_scanned,
    "normals": by_normal,
    "weight": by_weight,
    "height": by_height,
}
"""Name in the viewer → colours (N, 3) uint8 of a cloud."""


def _scale(values: Float32Array | AnyArray) -> ByteArray:
    if not len(values):
        return np.empty((0, 3), np.uint8)
    low, high = np.percentile(values, _RANGE_PERCENT)
    share = (values - low) / max(high - low, 1e-9)
    colours: ByteArray = matplotlib.colormaps["viridis"](np.clip(share, 0, 1), bytes=True)[:, :3]
    return colours
