"""Rays through the map: what stands along a line of sight, or in the way of the light."""

from __future__ import annotations

import numpy as np
from numba import njit

from vli_mapping.spatial_hash import bucket_of, cell_of, coordinates, same_cell


@njit(cache=True, nogil=True)
def direct(start, end, ray):  # type: ignore[no-untyped-def]
    """Write the unit direction from ``start`` to ``end`` (3,) into ``ray``; return the distance."""
    for axis in range(3):
        ray[axis] = end[axis] - start[axis]
    length = np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
    for axis in range(3):
        ray[axis] /= length
    return length


@njit(cache=True, nogil=True)
def cast(grid, columns, eye, ray, start, stop, radius, min_facing, rows, count):  # type: ignore[no-untyped-def]
    """Add the rows that a ray meets between two distances, within ``radius`` of it, to ``rows``.

    It meets none whose plane it grazes: the cosine between normal and ray is less than ``min_facing``.

    Only the cells that the ray itself crosses are visited (Amanatides and Woo 1987): the rays beside it see to the others.

    Returns:
        Count of rows, and the weight of the solid ones among those found.
    """
    heads, following, cell_m = grid
    position, normal, weight, solid = columns
    i = cell_of(eye[0] + start * ray[0], cell_m)
    j = cell_of(eye[1] + start * ray[1], cell_m)
    k = cell_of(eye[2] + start * ray[2], cell_m)
    step_i, face_i, width_i = _crossings(eye[0], ray[0], i, cell_m)
    step_j, face_j, width_j = _crossings(eye[1], ray[1], j, cell_m)
    step_k, face_k, width_k = _crossings(eye[2], ray[2], k, cell_m)
    total = 0.0
    reached = start
    while reached < stop:
        at = heads[bucket_of(i, j, k, len(heads))]
        while at >= 0:
            p = coordinates(position, at)
            x, y, z = p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]
            along = x * ray[0] + y * ray[1] + z * ray[2]
            if (
                start <= along <= stop
                and x * x + y * y + z * z - along * along < radius * radius
                and same_cell(p, i, j, k, cell_m)
                and not _grazes(coordinates(normal, at), ray, min_facing)
            ):
                total += weight[at] if solid[at] else 0.0
                if count < len(rows):
                    rows[count] = at
                    count += 1
            at = following[at]
        reached = min(face_i, face_j, face_k)
        if reached == face_i:
            i += step_i
            face_i += width_i
        elif reached == face_j:
            j += step_j
            face_j += width_j
        else:
            k += step_k
            face_k += width_k
    return count, total


@njit(cache=True, nogil=True)
def _crossings(start, slope, cell, cell_m):  # type: ignore[no-untyped-def]
    """Return, along one axis, the step from cell to cell, the distance of the first face, and that from face to face."""
    if slope == 0.0:
        return 0, np.inf, np.inf
    step = 1 if slope > 0 else -1
    return step, ((cell + max(step, 0)) * cell_m - start) / slope, cell_m / abs(slope)


@njit(cache=True, nogil=True)
def _grazes(normal, ray, min_facing):  # type: ignore[no-untyped-def]
    """Return True where the ray runs along the plane of a point that has one."""
    if normal[0] == 0 and normal[1] == 0 and normal[2] == 0:
        return False
    return abs(normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]) < min_facing
