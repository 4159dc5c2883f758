"""Which points of a stripe are to be trusted: not beside an occlusion edge, not grazing, seen by the scans beside it too.

The others may fly, or be ghosts: they only fill what nothing better has covered, and leave when something does.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from vli_common.arrays import BoolArray, Float32Array, FloatArray
from vli_mapping.config import EntryConfig
from vli_mapping.spatial_hash import SpatialHash, any_near, coordinates

_NOISE_SIGMAS = 3.0


def away_from_edges(points: FloatArray, sigma: FloatArray, config: EntryConfig) -> BoolArray:
    """Return which points (N,) of a stripe are no part of a short piece and not beside an occlusion edge.

    Args:
        points: (N, 3), camera frame, ordered along the stripe.
        sigma: (N,), metres, along the viewing ray.
        config: see :class:`EntryConfig`.
    """
    keep = np.ones(len(points), np.bool_)
    slope = np.tan(np.radians(config.max_incidence_deg))
    _trim_edges(points, sigma, config.edge_jump, slope, config.edge_trim, config.min_segment, keep)
    return keep


def supported(points: FloatArray, beside: FloatArray, radius: float) -> BoolArray:
    """Return for which points (N, 3) a point of the scans beside (M, 3) lies within ``radius``."""
    result = np.zeros(len(points), np.bool_)
    if len(beside):
        grid = SpatialHash.of(beside, radius)
        _mark_supported(grid.heads, grid.next, beside, grid.cell_m, points, radius, result)
    return result


def facing(points: FloatArray, normals: Float32Array, max_incidence_deg: float) -> BoolArray:
    """Return which points (N, 3) have a normal (N, 3), and are seen at less than ``max_incidence_deg`` from it; camera frame."""
    cosine = -np.einsum("ni,ni->n", points, normals) / np.linalg.norm(points, axis=1)
    result: BoolArray = cosine >= np.cos(np.radians(max_incidence_deg))
    return result


def noisy(points: FloatArray, sigma: FloatArray, max_ratio: float) -> BoolArray:
    """Return where the stripe is blurred beyond ``max_ratio`` of its median, as it is where it falls over an edge.

    The sigma of a triangulated point grows with z²; what is left is that of the pixel.
    """
    blur = sigma / points[:, 2] ** 2
    result: BoolArray = blur > max_ratio * np.median(blur)
    return result


@njit(cache=True, nogil=True)
def _trim_edges(points, sigma, edge_jump, slope, trim, min_segment, keep):  # type: ignore[no-untyped-def]
    """Cut the stripe where the range jumps; drop short pieces whole and ``trim`` points at the cut ends of the others."""
    count = len(points)
    start = 0
    for stop in range(1, count + 1):
        if stop < count and not jumps(points[stop - 1], points[stop], sigma[stop - 1] + sigma[stop], edge_jump, slope):
            continue
        if stop - start < min_segment:
            keep[start:stop] = False
        else:
            if start > 0:
                keep[start : start + trim] = False
            if stop < count:
                keep[stop - trim : stop] = False
        start = stop


@njit(cache=True, nogil=True)
def jumps(a, b, sigma, edge_jump, slope):  # type: ignore[no-untyped-def]
    """Return True where the step from a to b is farther along the ray than a surface at the largest incidence would go."""
    length = np.sqrt(a[0] ** 2 + a[1] ** 2 + a[2] ** 2)
    along = ((b[0] - a[0]) * a[0] + (b[1] - a[1]) * a[1] + (b[2] - a[2]) * a[2]) / length
    squared = (b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2 + (b[2] - a[2]) ** 2
    across = np.sqrt(max(squared - along * along, 0.0))
    return across > edge_jump or abs(along) > slope * across + _NOISE_SIGMAS * sigma


@njit(cache=True, nogil=True)
def _mark_supported(heads, following, beside, cell_m, points, radius, result):  # type: ignore[no-untyped-def]
    for index in range(len(points)):
        result[index] = any_near(heads, following, beside, coordinates(points, index), radius, cell_m)
