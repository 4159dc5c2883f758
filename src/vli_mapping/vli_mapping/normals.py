"""Normals from neighbouring points: a plane through those within a radius, by principal components.

The planarity of a neighbourhood is (1 − λ₀/λ₁) · min(1, 50 λ₁/λ₂) of the eigenvalues λ₀ ≤ λ₁ ≤ λ₂ of its covariance: near 1 on a
surface, small on an edge, in clutter (the first factor), and along a single stripe, whose points say nothing of the direction
across (the second). Where it is low there is no normal, (0, 0, 0).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from vli_common.arrays import Float32Array, FloatArray, IntArray
from vli_mapping.spatial_hash import SpatialHash, coordinates, neighbours

MAX_NEIGHBOURS = 192
MIN_NEIGHBOURS = 6
SPARSE = 3
"""One in so many points stands for all: pixels along a stripe are much closer than stripes are, and say the same."""
_LINE = 0.02
"""λ₁/λ₂ below which a neighbourhood is more of a line: stripes less than some 0.1 mm apart, at a radius of 0.8 mm."""


def stripe_normals(
    points: FloatArray, beside: FloatArray, radius: float, min_planarity: float
) -> tuple[Float32Array, Float32Array]:
    """Return normals (N, 3), towards the camera, and planarities (N,) of one stripe from itself and the scans beside it.

    Args:
        points: (N, 3), the stripe, in its camera frame.
        beside: (M, 3), the points of its neighbouring scans, in the same frame.
        radius: of the neighbourhood, metres.
        min_planarity: below it, and where only one scan is near, the normal is (0, 0, 0).
    """
    sparse = np.concatenate([points[::SPARSE], beside[::SPARSE]])
    grid = SpatialHash.of(sparse, radius)
    normals, planarity = np.zeros((len(points), 3), np.float32), np.zeros(len(points), np.float32)
    which = np.arange(len(points))
    _fit_normals(
        grid.heads, grid.next, sparse, grid.cell_m, points, which, np.zeros(3), radius, min_planarity, normals, planarity
    )
    return normals, planarity


def refine_normals(
    grid: SpatialHash,
    positions: FloatArray,
    which: IntArray,
    viewpoint: FloatArray,
    radius: float,
    min_planarity: float,
    normals: Float32Array,
    planarity: Float32Array,
) -> None:
    """Fit again, in place, the normals of points ``which`` (K,) of a map: (N, 3) positions and normals, (N,) planarity."""
    _fit_normals(
        grid.heads, grid.next, positions, grid.cell_m, positions, which, viewpoint, radius, min_planarity, normals, planarity
    )


@njit(cache=True, nogil=True)
def _fit_normals(  # type: ignore[no-untyped-def]
    heads, following, positions, cell_m, points, which, viewpoint, radius, min_planarity, normals, planarity
):
    found = np.empty(MAX_NEIGHBOURS, np.int64)
    plane = np.empty(8)
    for index in which:
        centre = coordinates(points, index)
        count = neighbours(heads, following, positions, centre, radius, cell_m, found)
        fit_plane(positions, found[:count], centre, plane)
        planarity[index] = plane[6]
        # Turning a normal once given by where it is seen from now keeps thin walls from flipping.
        old = normals[index, 0] ** 2 + normals[index, 1] ** 2 + normals[index, 2] ** 2
        side = 0.0
        for axis in range(3):
            towards = np.float64(normals[index, axis]) if old > 0 else viewpoint[axis] - centre[axis]
            side += plane[3 + axis] * towards
        sign = 1.0 if side >= 0 else -1.0
        good = count >= MIN_NEIGHBOURS and plane[6] >= min_planarity
        for axis in range(3):
            normals[index, axis] = sign * plane[3 + axis] if good else 0.0


def smooth_normals(
    grid: SpatialHash, positions: FloatArray, normals: Float32Array, which: IntArray, radius: float
) -> Float32Array:
    """Return the normals (K, 3) of points ``which``; where one is unknown, the mean of those within ``radius``, 0 without any."""
    result = normals[which]
    _fill_normals(grid.heads, grid.next, positions, grid.cell_m, normals, which, radius, result)
    return result


@njit(cache=True, nogil=True)
def _fill_normals(heads, following, positions, cell_m, normals, which, radius, result):  # type: ignore[no-untyped-def]
    found = np.empty(MAX_NEIGHBOURS, np.int64)
    for index in range(len(which)):
        if result[index, 0] != 0 or result[index, 1] != 0 or result[index, 2] != 0:
            continue
        count = neighbours(heads, following, positions, positions[which[index]], radius, cell_m, found)
        norm = 0.0
        for axis in range(3):
            for at in found[:count]:
                result[index, axis] += normals[at, axis]
            norm += result[index, axis] ** 2
        if norm > 0:
            result[index] /= np.sqrt(norm)


@njit(cache=True, nogil=True)
def fit_plane(positions, which, origin, plane):  # type: ignore[no-untyped-def]
    """Fit a plane to points ``which`` (K,) of ``positions``; sums are taken about ``origin`` (3,).

    Writes into ``plane`` (8,): centroid, unit normal, planarity in [0, 1], RMS distance to the plane. Planarity is 0 where there
    are fewer than 3 points.
    """
    count = len(which)
    plane[3:] = 0.0
    if count < 3:
        plane[:3] = origin
        return
    mean_x = mean_y = mean_z = 0.0
    for index in which:
        mean_x += positions[index, 0] - origin[0]
        mean_y += positions[index, 1] - origin[1]
        mean_z += positions[index, 2] - origin[2]
    mean_x, mean_y, mean_z = mean_x / count, mean_y / count, mean_z / count
    xx = xy = xz = yy = yz = zz = 0.0
    for index in which:
        x = positions[index, 0] - origin[0] - mean_x
        y = positions[index, 1] - origin[1] - mean_y
        z = positions[index, 2] - origin[2] - mean_z
        xx += x * x
        xy += x * y
        xz += x * z
        yy += y * y
        yz += y * z
        zz += z * z
    plane[0], plane[1], plane[2] = origin[0] + mean_x, origin[1] + mean_y, origin[2] + mean_z
    smallest, middle, largest = smallest_eigenvector(
        xx / count, xy / count, xz / count, yy / count, yz / count, zz / count, plane[3:6]
    )
    if middle > 0:
        plane[6] = (1.0 - smallest / middle) * min(1.0, middle / (_LINE * largest))
    plane[7] = np.sqrt(smallest)


@njit(cache=True, nogil=True)
def smallest_eigenvector(xx, xy, xz, yy, yz, zz, vector):  # type: ignore[no-untyped-def]
    """Write the eigenvector of the smallest eigenvalue of a symmetric positive semi-definite 3×3; return all three, ascending.

    The closed form of Smith (1961). ``vector`` is zero where the two smallest eigenvalues coincide.
    """
    vector[:] = 0.0
    mean = (xx + yy + zz) / 3
    off = xy * xy + xz * xz + yz * yz
    spread = np.sqrt(((xx - mean) ** 2 + (yy - mean) ** 2 + (zz - mean) ** 2 + 2 * off) / 6)
    if spread <= 1e-12 * mean or mean <= 0:
        return max(mean, 0.0), max(mean, 0.0), max(mean, 0.0)
    a, b, c, d, e, f = (xx - mean) / spread, xy / spread, xz / spread, (yy - mean) / spread, yz / spread, (zz - mean) / spread
    half = (a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)) / 2
    angle = np.arccos(min(1.0, max(-1.0, half))) / 3
    largest = 2 * np.cos(angle)
    lowest = 2 * np.cos(angle + 2 * np.pi / 3)
    # Rows of (B − λ): the longest of their cross products is the best conditioned.
    a, d, f = a - lowest, d - lowest, f - lowest
    best = 0.0
    for x, y, z in (
        (b * e - c * d, b * c - a * e, a * d - b * b),
        (b * f - c * e, c * c - a * f, a * e - b * c),
        (d * f - e * e, c * e - b * f, b * e - c * d),
    ):
        norm = x * x + y * y + z * z
        if norm > best:
            best = norm
            vector[0], vector[1], vector[2] = x, y, z
    if best > 1e-20:
        length = np.sqrt(best)
        vector[0], vector[1], vector[2] = vector[0] / length, vector[1] / length, vector[2] / length
    else:
        vector[:] = 0.0
    return max(mean + spread * lowest, 0.0), max(mean - spread * (largest + lowest), 0.0), mean + spread * largest
