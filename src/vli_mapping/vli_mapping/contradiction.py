"""What a view of the surface speaks against: points that would have hidden it, and points that it would have hidden.

Between the camera and a point of the stripe there is nothing: a map point on that ray, clearly in front of its end, is
contradicted. So is a point behind the stripe, where the map stands in the way of the view that brought it. Each scan that
contradicts a point halves its weight, as each merge adds to it: what is seen again stays, a ghost leaves. Where much of the map
stands in the way of a new point, it is the new one that is doubted. A ray that grazes the plane of a point says nothing of it: at
an edge, half of them pass.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit

from vli_mapping.point_map import PointMap, Stripe
from vli_mapping.spatial_hash import bucket_of, cell_of, same_cell

_STRIDE = 3
"""Of the stripe's points: their rays are closer than the radius about them all the same."""
_REACH_M = 0.012
"""How far in front of the stripe, and behind it, points are looked for: the height of what a scanner this near looks into."""
_NOISE_SIGMAS = 3.0
_MIN_FACING = 0.3
_MOST_ROWS = 4096


def contradict(point_map: PointMap, stripe: Stripe) -> tuple[Stripe, int]:
    """Halve the weight of the points that a stripe, which has not entered yet, contradicts; those with no more than one leave.

    Returns:
        The stripe, its points that the map would hide no longer solid, and how many points left.
    """
    c, config = point_map.columns, point_map.config
    if not config.ray_radius or not len(point_map):
        return stripe, 0
    hidden, rows = np.zeros(len(stripe), np.bool_), np.empty(_MOST_ROWS, np.int64)
    count = _cast_stripe(
        (point_map.grid.heads, point_map.grid.next, point_map.grid.cell_m),
        (c.position, c.normal, c.weight, c.solid),
        (c.scan, point_map.views),
        stripe.viewpoint,
        (stripe.points, stripe.sigma, stripe.solid),
        (config.ray_radius, config.ray_margin, config.hiding_weight),
        rows,
        hidden,
    )
    return replace(stripe, solid=stripe.solid & ~hidden), point_map.halve(np.unique(rows[:count]))


@njit(cache=True, nogil=True)
def _cast_stripe(grid, columns, seen, eye, stripe, limits, rows, hidden):  # type: ignore[no-untyped-def]
    """Write the rows that a stripe contradicts, some of them several times, into ``rows``; return how many.

    Args:
        grid: heads, next and cell of the map's hash.
        columns: position, normal, weight and solid of the map.
        seen: number of the scan of each row, and (S, 3, 4) poses of the scans.
        eye: (3,) camera centre of the stripe.
        stripe: points, sigma and solid.
        limits: radius about a ray, margin at its end, weight in the way of a ray that hides its end.
        rows: the answer.
        hidden: (N,), gets True for points of the stripe that the map would hide.
    """
    points, sigma, solid = stripe
    radius, margin, hides = limits
    position = columns[0]
    scan, views = seen
    ray, behind, unused = np.empty(3), np.empty(64, np.int64), np.empty(64, np.int64)
    count = 0
    for index in range(0, len(points), _STRIDE):
        if not solid[index]:
            continue
        length = _direct(eye, points[index], ray)
        gap = margin + _NOISE_SIGMAS * sigma[index]
        count, in_the_way = _cast(grid, columns, eye, ray, length - _REACH_M, length - gap, radius, rows, count)
        hidden[index : index + _STRIDE] |= in_the_way >= hides
        found, _ = _cast(grid, columns, eye, ray, length + gap, length + _REACH_M, 2 * radius, behind, 0)
        for at in behind[:found]:
            own = views[scan[at], :, 3]
            distance = _direct(own, position[at], ray)
            _, in_the_way = _cast(grid, columns, own, ray, distance - _REACH_M, distance - gap, radius, unused, 0)
            if in_the_way >= hides and count < len(rows):
                rows[count] = at
                count += 1
    return count


@njit(cache=True, nogil=True)
def _direct(start, end, ray):  # type: ignore[no-untyped-def]
    """Write the unit direction from ``start`` to ``end`` (3,) into ``ray``; return the distance."""
    for axis in range(3):
        ray[axis] = end[axis] - start[axis]
    length = np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
    ray /= length
    return length


@njit(cache=True, nogil=True)
def _cast(grid, columns, eye, ray, start, stop, radius, rows, count):  # type: ignore[no-untyped-def]
    """Add the rows that a ray does not graze, between two distances and within ``radius`` of it, to ``rows``.

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
            p = position[at]
            x, y, z = p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]
            along = x * ray[0] + y * ray[1] + z * ray[2]
            if (
                start <= along <= stop
                and x * x + y * y + z * z - along * along < radius * radius
                and same_cell(p, i, j, k, cell_m)
                and not _grazes(normal[at], ray)
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
def _grazes(normal, ray):  # type: ignore[no-untyped-def]
    """Return True where the ray runs along the plane of a point that has one."""
    if normal[0] == 0 and normal[1] == 0 and normal[2] == 0:
        return False
    return abs(normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]) < _MIN_FACING
