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
from vli_mapping.ray_casting import cast, direct

_STRIDE = 3
"""Of the stripe's points: their rays are closer than the radius about them all the same."""
_REACH_M = 0.012
"""How far in front of the stripe, and behind it, points are looked for: the height of what a scanner this near looks into."""
_NOISE_SIGMAS = 3.0
_MIN_FACING = 0.3
"""Cosine between normal and ray below which a ray grazes the plane of a point."""
_MOST_ROWS = 4096


def contradict(point_map: PointMap, stripe: Stripe) -> tuple[Stripe, int, int]:
    """Halve the weight of the points that a stripe, which has not entered yet, contradicts; those with no more than one leave.

    Returns:
        The stripe, its points that the map would hide no longer solid; how many points left, and how many more with them,
        see :mod:`vli_mapping.pieces`.
    """
    c, config = point_map.columns, point_map.config
    if not config.ray_radius or not len(point_map):
        return stripe, 0, 0
    hidden, rows, by = np.zeros(len(stripe), np.bool_), np.empty(_MOST_ROWS, np.int64), np.empty(_MOST_ROWS, np.int64)
    count = _cast_stripe(
        (point_map.grid.heads, point_map.grid.next, point_map.grid.cell_m),
        (c.position, c.normal, c.weight, c.solid),
        (c.scan, point_map.views),
        stripe.viewpoint,
        (stripe.points, stripe.sigma, stripe.solid),
        (config.ray_radius, config.ray_margin, config.hiding_weight),
        rows,
        by,
        hidden,
    )
    left = point_map.halve(np.unique(rows[:count]))
    more = point_map.remove_with(rows[:count], stripe.points[by[:count]], stripe.number)
    return replace(stripe, solid=stripe.solid & ~hidden), left, more


@njit(cache=True, nogil=True)
def _cast_stripe(grid, columns, seen, eye, stripe, limits, rows, by, hidden):  # type: ignore[no-untyped-def]
    """Write the rows that a stripe contradicts, some of them several times, into ``rows``; return how many.

    Args:
        grid: heads, next and cell of the map's hash.
        columns: position, normal, weight and solid of the map.
        seen: number of the scan of each row, and (S, 3, 4) poses of the scans.
        eye: (3,) camera centre of the stripe.
        stripe: points, sigma and solid.
        limits: radius about a ray, margin at its end, weight in the way of a ray that hides its end.
        rows: the answer.
        by: which point of the stripe contradicts each of them.
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
        length = direct(eye, points[index], ray)
        gap = margin + _NOISE_SIGMAS * sigma[index]
        first = count
        count, in_the_way = cast(grid, columns, eye, ray, length - _REACH_M, length - gap, radius, _MIN_FACING, rows, count)
        hidden[index : index + _STRIDE] |= in_the_way >= hides
        found, _ = cast(grid, columns, eye, ray, length + gap, length + _REACH_M, 2 * radius, _MIN_FACING, behind, 0)
        for at in behind[:found]:
            own = views[scan[at], :, 3]
            distance = direct(own, position[at], ray)
            _, in_the_way = cast(grid, columns, own, ray, distance - _REACH_M, distance - gap, radius, _MIN_FACING, unused, 0)
            if in_the_way >= hides and count < len(rows):
                rows[count] = at
                count += 1
        by[first:count] = index
    return count
