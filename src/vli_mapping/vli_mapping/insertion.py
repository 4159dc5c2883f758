"""How a stripe enters the map: kernels over the map's columns and its hash."""

from __future__ import annotations

import numpy as np
from numba import njit

from vli_mapping.spatial_hash import bucket_of, cell_of, coordinates, link_one, same_cell, unlink_one

ROWS, FREE_HEAD, FREE = 0, 1, 2
"""Of the state (3,): rows in use, first of the chain of free rows among them (−1: none), and how many these are."""
VISIT_SCANS = 15
"""Scans apart, half a second, up to which two colours of a point are averaged."""
_BETTER = 2.0
"""Times the light from which on a later visit replaces a colour: what is much the same does not change to and fro."""


@njit(cache=True, nogil=True)
def insert_stripe(  # type: ignore[no-untyped-def]
    heads, following, cell_m, state, columns, views, stripe, number, stamp_ns, limits, target
):
    """Merge or add every point of a stripe, solid ones first; write its row, or −1, into ``target`` (N,).

    Args:
        heads, following, cell_m: the hash of the map.
        state: (3,), see ``ROWS``.
        columns: of ``Columns``, in its order.
        views: (S, 3, 4), poses of the scans, this one's too.
        stripe: points, normals, colours, sigma, planarity, solid of ``Stripe``.
        number, stamp_ns: of the scan.
        limits: merge radius, cosine of the merge angle, merge colour, cap on the weight, fill radius.
        target: the answer.
    """
    position, solid = columns[0], columns[9]
    points, stripe_solid = stripe[0], stripe[5]
    merge_radius, fill_radius = limits[0], limits[4]
    for wanted in (True, False):
        for index in range(len(points)):
            if stripe_solid[index] != wanted:
                continue
            p = coordinates(points, index)
            target[index] = -1
            if not wanted and _covered(heads, following, cell_m, position, solid, p, fill_radius):
                continue
            at = _nearest_compatible(heads, following, cell_m, columns, p, stripe, index, merge_radius, limits)
            if at >= 0:
                _merge(heads, following, cell_m, at, columns, views, stripe, index, number, limits[3])
            else:
                if wanted:
                    _drop_doubtful(heads, following, cell_m, state, columns, p, fill_radius)
                at = _add(heads, following, cell_m, state, columns, stripe, index, number, stamp_ns)
            target[index] = at


@njit(cache=True, nogil=True)
def _add(heads, following, cell_m, state, columns, stripe, index, number, stamp_ns):  # type: ignore[no-untyped-def]
    """Write a point into a row that is free, else into a new one; return the row."""
    position, normal, colour, weight, sigma, planarity, scan, seen_by, entered_ns, solid, albedo, albedo_weight, albedo_power = (
        columns
    )
    points, normals, colours, sigmas, planarities, stripe_solid = stripe
    at = state[FREE_HEAD]
    if at >= 0:
        state[FREE_HEAD] = following[at]
        state[FREE] -= 1
    else:
        at = state[ROWS]
        state[ROWS] += 1
    position[at] = points[index]
    normal[at] = normals[index]
    colour[at] = colours[index]
    weight[at] = 1.0
    sigma[at] = sigmas[index]
    planarity[at] = planarities[index]
    scan[at] = number
    seen_by[at] = number
    entered_ns[at] = stamp_ns
    solid[at] = stripe_solid[index]
    albedo[at] = 0.0
    albedo_weight[at] = 0.0
    albedo_power[at] = 0.0
    link_one(heads, following, at, position[at], cell_m)
    return at


@njit(cache=True, nogil=True)
def _covered(heads, following, cell_m, position, solid, p, radius):  # type: ignore[no-untyped-def]
    """Return True where a solid point lies within ``radius`` of ``p``."""
    for i in range(cell_of(p[0] - radius, cell_m), cell_of(p[0] + radius, cell_m) + 1):
        for j in range(cell_of(p[1] - radius, cell_m), cell_of(p[1] + radius, cell_m) + 1):
            for k in range(cell_of(p[2] - radius, cell_m), cell_of(p[2] + radius, cell_m) + 1):
                at = heads[bucket_of(i, j, k, len(heads))]
                while at >= 0:
                    if solid[at] and squared_distance(coordinates(position, at), p) <= radius * radius:
                        return True
                    at = following[at]
    return False


@njit(cache=True, nogil=True)
def _drop_doubtful(heads, following, cell_m, state, columns, p, radius):  # type: ignore[no-untyped-def]
    """Let the doubtful points within ``radius`` of ``p`` leave: their rows are free."""
    position, weight, solid = columns[0], columns[3], columns[9]
    for i in range(cell_of(p[0] - radius, cell_m), cell_of(p[0] + radius, cell_m) + 1):
        for j in range(cell_of(p[1] - radius, cell_m), cell_of(p[1] + radius, cell_m) + 1):
            for k in range(cell_of(p[2] - radius, cell_m), cell_of(p[2] + radius, cell_m) + 1):
                at = heads[bucket_of(i, j, k, len(heads))]
                while at >= 0:
                    after = following[at]
                    if not solid[at] and squared_distance(position[at], p) <= radius * radius:
                        remove_one(heads, following, cell_m, state, position, weight, at)
                    at = after


@njit(cache=True, nogil=True)
def remove(heads, following, cell_m, state, position, weight, which):  # type: ignore[no-untyped-def]
    """Let the points of rows ``which`` (K,) leave."""
    for at in which:
        remove_one(heads, following, cell_m, state, position, weight, at)


@njit(cache=True, nogil=True)
def remove_one(heads, following, cell_m, state, position, weight, at):  # type: ignore[no-untyped-def]
    """Take a point out of its chain; its row is the next that is used again."""
    unlink_one(heads, following, at, position[at], cell_m)
    weight[at] = 0.0
    following[at] = state[FREE_HEAD]
    state[FREE_HEAD] = at
    state[FREE] += 1


@njit(cache=True, nogil=True)
def squared_distance(a, b):  # type: ignore[no-untyped-def]
    """Return |a − b|² of two points (3,)."""
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


@njit(cache=True, nogil=True)
def _nearest_compatible(heads, following, cell_m, columns, p, stripe, index, radius, limits):  # type: ignore[no-untyped-def]
    """Return the row of the nearest point, as solid as the stripe's, that agrees in normal and colour; −1 where there is none."""
    position, normal, colour, solid = columns[0], columns[1], columns[2], columns[9]
    n, c, wanted = coordinates(stripe[1], index), coordinates(stripe[2], index), stripe[5][index]
    best = np.int64(-1)
    nearest = radius * radius
    for i in range(cell_of(p[0] - radius, cell_m), cell_of(p[0] + radius, cell_m) + 1):
        for j in range(cell_of(p[1] - radius, cell_m), cell_of(p[1] + radius, cell_m) + 1):
            for k in range(cell_of(p[2] - radius, cell_m), cell_of(p[2] + radius, cell_m) + 1):
                at = np.int64(heads[bucket_of(i, j, k, len(heads))])
                while at >= 0:
                    distance = squared_distance(coordinates(position, at), p)
                    if (
                        distance < nearest
                        and solid[at] == wanted
                        and normals_agree(coordinates(normal, at), n, limits[1])
                        and colours_agree(coordinates(colour, at), c, limits[2])
                    ):
                        best = at
                        nearest = distance
                    at = np.int64(following[at])
    return best


@njit(cache=True, nogil=True)
def normals_agree(a, b, min_cosine):  # type: ignore[no-untyped-def]
    """Return True where two normals (3,) are within the angle, or one is unknown (0)."""
    if (a[0] == 0 and a[1] == 0 and a[2] == 0) or (b[0] == 0 and b[1] == 0 and b[2] == 0):
        return True
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] >= min_cosine


@njit(cache=True, nogil=True)
def colours_agree(a, b, limit):  # type: ignore[no-untyped-def]
    """Return True where two colours (3,) differ by at most ``limit`` in every channel, or one is unknown (NaN)."""
    # Written so that NaN passes.
    return not (abs(a[0] - b[0]) > limit or abs(a[1] - b[1]) > limit or abs(a[2] - b[2]) > limit)


@njit(cache=True, nogil=True)
def _merge(heads, following, cell_m, at, columns, views, stripe, index, number, max_weight):  # type: ignore[no-untyped-def]
    """Average point ``index`` of a stripe into row ``at``."""
    position, normal, colour, weight, sigma = columns[:5]
    seen_by = columns[7]
    p, n, c, sigma_new = stripe[0][index], stripe[1][index], stripe[2][index], stripe[3][index]
    old_information, new_information = 1.0 / np.float64(sigma[at]) ** 2, 1.0 / np.float64(sigma_new) ** 2
    gain = new_information / (old_information + new_information)
    old = position[at]
    moved = (old[0] + gain * (p[0] - old[0]), old[1] + gain * (p[1] - old[1]), old[2] + gain * (p[2] - old[2]))
    same = same_cell(moved, cell_of(old[0], cell_m), cell_of(old[1], cell_m), cell_of(old[2], cell_m), cell_m)
    if not same:
        unlink_one(heads, following, at, old, cell_m)
    old[0], old[1], old[2] = moved
    if not same:
        link_one(heads, following, at, moved, cell_m)
    share = 1.0 / (weight[at] + 1.0)
    _blend_normal(normal[at], n, share)
    _blend_colour(colour[at], c, share, seen_by, at, number, _is_better_view(views, seen_by[at], number, moved, normal[at]))
    information = old_information + new_information
    merged = weight[at] + 1.0
    if merged > max_weight:
        information *= max_weight / merged
        merged = max_weight
    weight[at] = merged
    sigma[at] = 1.0 / np.sqrt(information)


@njit(cache=True, nogil=True)
def _is_better_view(views, old, new, p, normal):  # type: ignore[no-untyped-def]
    """Return True where scan ``new`` got clearly more of the light that travels with the camera from ``p`` (3,) than ``old``."""
    return _brightness(views[new, :, 3], p, normal) > _BETTER * _brightness(views[old, :, 3], p, normal)


@njit(cache=True, nogil=True)
def _brightness(eye, p, normal):  # type: ignore[no-untyped-def]
    """Return cosine over squared distance; the cosine of an unknown normal is 1."""
    x, y, z = eye[0] - p[0], eye[1] - p[1], eye[2] - p[2]
    squared = x * x + y * y + z * z
    if normal[0] == 0 and normal[1] == 0 and normal[2] == 0:
        return 1.0 / squared
    return max(normal[0] * x + normal[1] * y + normal[2] * z, 0.0) / (squared * np.sqrt(squared))


@njit(cache=True, nogil=True)
def _blend_colour(colour, c, share, seen_by, at, number, is_better):  # type: ignore[no-untyped-def]
    """Turn a colour (3,), in place, towards ``c`` by ``share``, where both are of one visit; an unknown one takes the other.

    The light moves with the camera: the mean of two visits is what neither saw, and no one light can be taken out of it. So of
    two visits the one with the better view counts.
    """
    if np.isnan(c[0]):
        return
    if np.isnan(colour[0]) or (is_better and number - seen_by[at] > VISIT_SCANS):
        colour[:] = c
        seen_by[at] = number
    elif number - seen_by[at] <= VISIT_SCANS:
        for channel in range(3):
            colour[channel] += share * (c[channel] - colour[channel])


@njit(cache=True, nogil=True)
def _blend_normal(normal, n, share):  # type: ignore[no-untyped-def]
    """Turn a normal (3,), in place, towards ``n`` by ``share``; an unknown one takes the other."""
    if n[0] == 0 and n[1] == 0 and n[2] == 0:
        return
    if normal[0] == 0 and normal[1] == 0 and normal[2] == 0:
        normal[:] = n
        return
    norm = 0.0
    for axis in range(3):
        normal[axis] += share * (n[axis] - normal[axis])
        norm += normal[axis] ** 2
    if norm > 0:
        normal /= np.sqrt(norm)
