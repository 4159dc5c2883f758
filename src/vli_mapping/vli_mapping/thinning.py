"""A map small enough for a topic: one point a voxel."""

from __future__ import annotations

import numpy as np
from numba import njit

from vli_common.arrays import Float32Array, FloatArray, IntArray
from vli_mapping.spatial_hash import SpatialHash, bucket_of, cell_of, link_one, unlink_one

SMALLEST_VOXEL_M = 2.5e-4


def thin(points: FloatArray, weights: Float32Array, max_points: int) -> IntArray:
    """Return indices (K ≤ max_points,), ascending: of each voxel the heaviest point, the first of equals.

    Args:
        points: (N, 3) metres.
        weights: (N,).
        max_points: the voxel's edge grows from the smallest one until so few remain.
    """
    edge = SMALLEST_VOXEL_M
    while len(kept := thin_to_voxel(points, weights, edge)) > max_points:
        # Points lie on surfaces: their number falls with the square of the edge; never by less than a little.
        edge *= max(1.02, 0.98 * (len(kept) / max_points) ** 0.5)
    return kept


def thin_to_voxel(points: FloatArray, weights: Float32Array, edge: float) -> IntArray:
    """Return indices (K,), ascending: of each voxel of ``edge`` metres the heaviest of points (N, 3), the first of equals."""
    heads = SpatialHash(edge, len(points))
    kept = np.zeros(len(points), np.bool_)
    _mark_heaviest(heads.heads, heads.next, points, weights, edge, kept)
    return np.flatnonzero(kept)


@njit(cache=True, nogil=True)
def _mark_heaviest(heads, following, points, weights, edge, kept):  # type: ignore[no-untyped-def]
    """Chain one point a voxel, the heaviest so far."""
    for index in range(len(points)):
        p = points[index]
        i, j, k = cell_of(p[0], edge), cell_of(p[1], edge), cell_of(p[2], edge)
        at = heads[bucket_of(i, j, k, len(heads))]
        while at >= 0:
            q = points[at]
            if cell_of(q[0], edge) == i and cell_of(q[1], edge) == j and cell_of(q[2], edge) == k:
                break
            at = following[at]
        if at >= 0 and weights[at] >= weights[index]:
            continue
        if at >= 0:
            kept[at] = False
            unlink_one(heads, following, at, points[at], edge)
        kept[index] = True
        link_one(heads, following, index, p, edge)
