"""Colours of a finished map without the light on board: what single points do not tell, their neighbourhood does.

A colour divided by the shading of its view (see ``light``) is the better the more light there was. On a flank, an error δ of the
normal is one of tan β · δ in the shading; on an edge the normal itself means little; in a shadow the shading is something else
altogether. So the normals of this correction are means over the neighbours on the same face, points that others keep from the
light are found, and each colour is drawn towards that of its neighbourhood by how much it is to be doubted: with the doubt d, a
variance in units of how colours vary from point to point, it keeps the share 1 / (1 + d).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit

from vli_common.arrays import BoolArray, Float32Array, FloatArray, IntArray
from vli_common.types import PointCloud
from vli_mapping.light import Light
from vli_mapping.normals import MAX_NEIGHBOURS
from vli_mapping.point_map import Columns, PointMap, to_bytes
from vli_mapping.ray_casting import cast, direct
from vli_mapping.spatial_hash import SpatialHash, neighbours

_REACH = 2.0
"""Times the radius of the normals: the neighbourhood."""
_SPARSE = 3
"""One in so many points is a neighbour: those along a stripe say the same."""
_SAME_FACE = float(np.cos(np.radians(40.0)))
"""Cosine between normals of one face: nearer than the flank of a key is to its top."""
_UNLIT, _ENOUGH, _MISFIT, _CURVED = 0.4, 3.0, 200.0, 1.0
"""Doubt of a point that has been in the light of the reference once less than in enough of it; of one whose views have nothing in
common; and per unit of the tan² that the scatter of the normals around comes to."""
_LEAST_WEIGHT = 1e-3
_ROUGH, _SHADOWED = 4.0, 10.0
"""Doubt of a point that has no normal of its own or may fly, and of one that the light does not reach."""
_LEAST = 0.02
"""Doubt of the best neighbour: one alone is no better than several."""
_LEAST_AGREEMENT = 0.1
_CHUNK = 1 << 17
"""Points whose views are gathered at a time: each is a matrix."""
_SHADOW_M, _SHADOW_HEIGHT_M, _SHADOW_RADIUS_M, _SHADOW_WEIGHT = 0.012, 4e-4, 3e-4, 2.0
"""How far towards the light something is looked for, from what height above the face on, how near to the ray, and how much of it
is a shadow."""
_LEAST_FACING = 0.15
"""Cosine between normal and ray of light below which the ray runs along the face."""


def finished_cloud(point_map: PointMap, light: Light | None, as_seen: bool, stamp_ns: int = 0, session: int = 0) -> PointCloud:
    """Return a whole map as a cloud of its own memory, for a file: colours take their neighbourhood into account.

    Args:
        point_map: what to show.
        light: of the scan; None leaves the colours as they are in the images.
        as_seen: see :meth:`PointMap.shown_colours`; such colours are those of single points.
        stamp_ns, session: of the cloud.
    """
    if light is None or as_seen or not len(point_map):
        return point_map.cloud(None, stamp_ns, session, light, as_seen)
    return replace(point_map.cloud(None, stamp_ns, session), colours=to_bytes(albedo(point_map, light)))


def albedo(point_map: PointMap, light: Light) -> Float32Array:
    """Return the colours (N, 3) of a map's points, N ≥ 1, in the order of its rows, under the reference light; NaN = unknown.

    Args:
        point_map: what to show.
        light: of the scan that made it.
    """
    c, which = point_map.columns, point_map.alive()
    around = _neighbourhood(point_map, which)
    normals, agreement = around.mean_normals(c.normal[which])
    shading, dark = np.empty(len(which)), np.empty(len(which), np.bool_)
    for start in range(0, len(which), _CHUNK):
        part = slice(start, start + _CHUNK)
        shading[part], dark[part] = light_on(point_map, light, which[part], normals[part])
    colours, weight, misfit = _by_all_views(c.at(which), shading)
    doubt = (
        _UNLIT * np.maximum(1.0 / weight - 1.0 / _ENOUGH, 0.0)
        + _MISFIT * misfit
        + _CURVED * (1.0 / agreement**2 - 1.0)
        + _ROUGH * ~c.normal[which].any(axis=1)
        + _ROUGH * ~c.solid[which]
        + _SHADOWED * dark
    )
    return around.blend(colours, doubt)


def mean_normals(point_map: PointMap, which: IntArray) -> Float32Array:
    """Return the normals (K, 3) of the faces that rows ``which`` of a map are on, 0 where none is known."""
    return _neighbourhood(point_map, which).mean_normals(point_map.columns.normal[which])[0]


def _by_all_views(points: Columns, shading: FloatArray) -> tuple[Float32Array, FloatArray, FloatArray]:
    """Return what the views of the colours, of a ``shading`` (K,), and all photographs say together, see ``photographs``.

    Returns:
        Albedo (K, 3), Σ E² (K,), and how badly they agree (K,), 0 … 1.
    """
    seen = ~np.isnan(points.colour[:, 0])
    colour, shading = np.where(seen[:, None], points.colour, 0.0), np.where(seen, shading, 0.0)
    weight = points.albedo_weight + shading**2
    total = points.albedo * points.albedo_weight[:, None] + colour * shading[:, None]
    power = points.albedo_power + colour.mean(axis=1) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        colours = (total / weight[:, None]).astype(np.float32)
        misfit = np.nan_to_num(1.0 - total.mean(axis=1) ** 2 / (weight * power), posinf=0.0, neginf=0.0)
    return colours, np.maximum(weight, _LEAST_WEIGHT), np.maximum(misfit, 0.0)


def _neighbourhood(point_map: PointMap, which: IntArray) -> _Neighbourhood:
    return _Neighbourhood(point_map.columns.position[which], _REACH * point_map.config.normal_radius)


def light_on(point_map: PointMap, light: Light, which: IntArray, normals: Float32Array) -> tuple[FloatArray, BoolArray]:
    """Return the shading (K,) of points of a map in the views of their colours, and where the map keeps the light off.

    Args:
        point_map: what is lit, and what stands in the way.
        light: of the scan.
        which: (K,) rows.
        normals: (K, 3) of the faces that the points are on, 0 = unknown.
    """
    c = point_map.columns
    position, view = c.position[which], point_map.views[c.seen_by[which]]
    local = np.einsum("nji,nj->ni", view[:, :, :3], position - view[:, :, 3])
    shading = light.shading(local, np.einsum("nji,nj->ni", view[:, :, :3], normals))
    shadowed = np.empty(len(which), np.bool_)
    _mark_shadowed(
        (point_map.grid.heads, point_map.grid.next, point_map.grid.cell_m),
        (c.position, c.normal, c.weight, c.solid),
        view[:, :, :3] @ light.position + view[:, :, 3],
        position,
        normals,
        shadowed,
    )
    return shading, shadowed


class _Neighbourhood:
    """Points (N, 3) and those of them within a radius, metres, that count as neighbours."""

    def __init__(self, points: FloatArray, radius: float) -> None:
        self._points, self._sparse, self._radius = points, np.ascontiguousarray(points[::_SPARSE]), radius
        grid = SpatialHash.of(self._sparse, radius)
        self._grid = (grid.heads, grid.next, grid.cell_m)

    def mean_normals(self, normals: Float32Array) -> tuple[Float32Array, FloatArray]:
        """Return the mean normal (N, 3) of the face that each point is on, 0 where none is known, and the agreement (N,).

        That is the length of the sum over the number of all normals (N, 3) around; those of other faces are not in the sum.
        """
        mean, agreement = np.empty_like(normals), np.empty(len(normals))
        beside = np.ascontiguousarray(normals[::_SPARSE])
        _average_normals(self._grid, self._sparse, beside, self._radius, self._points, normals, mean, agreement)
        return mean, agreement

    def blend(self, colours: Float32Array, doubt: FloatArray) -> Float32Array:
        """Return colours (N, 3) drawn, by their doubt (N,), towards the mean of the neighbours, which counts these by theirs."""
        result = np.empty_like(colours)
        beside, weight = np.ascontiguousarray(colours[::_SPARSE]), 1.0 / (doubt[::_SPARSE] + _LEAST)
        _blend(self._grid, self._sparse, beside, weight, self._radius, self._points, colours, doubt, result)
        return result


@njit(cache=True, nogil=True)
def _average_normals(grid, sparse, beside, radius, points, normals, mean, agreement):  # type: ignore[no-untyped-def]
    heads, following, cell_m = grid
    found = np.empty(MAX_NEIGHBOURS, np.int64)
    for index in range(len(points)):
        count = neighbours(heads, following, sparse, points[index], radius, cell_m, found)
        own, known = normals[index], 0
        # A point counts for itself: it may be none of the sparse ones.
        x, y, z = np.float64(own[0]), np.float64(own[1]), np.float64(own[2])
        has_own = x != 0 or y != 0 or z != 0
        if has_own:
            known = 1
        for at in found[:count]:
            n = beside[at]
            if n[0] == 0 and n[1] == 0 and n[2] == 0:
                continue
            known += 1
            if not has_own or own[0] * n[0] + own[1] * n[1] + own[2] * n[2] >= _SAME_FACE:
                x += n[0]
                y += n[1]
                z += n[2]
        length = np.sqrt(x * x + y * y + z * z)
        scale = 1.0 / length if length > 0 else 0.0
        mean[index, 0], mean[index, 1], mean[index, 2] = x * scale, y * scale, z * scale
        agreement[index] = max(length / max(known, 1), _LEAST_AGREEMENT)


@njit(cache=True, nogil=True)
def _blend(grid, sparse, beside, weight, radius, points, colours, doubt, result):  # type: ignore[no-untyped-def]
    heads, following, cell_m = grid
    found, total = np.empty(MAX_NEIGHBOURS, np.int64), np.empty(3)
    for index in range(len(points)):
        result[index] = colours[index]
        if np.isnan(colours[index, 0]):
            continue
        count = neighbours(heads, following, sparse, points[index], radius, cell_m, found)
        total[:] = 0.0
        weights = 0.0
        for at in found[:count]:
            if not np.isnan(beside[at, 0]):
                weights += weight[at]
                for channel in range(3):
                    total[channel] += weight[at] * beside[at, channel]
        if weights > 0:
            share = 1.0 / (1.0 + doubt[index])
            for channel in range(3):
                result[index, channel] = share * colours[index, channel] + (1.0 - share) * total[channel] / weights


@njit(cache=True, nogil=True)
def _mark_shadowed(grid, columns, lights, points, normals, result):  # type: ignore[no-untyped-def]
    """Say of which points (N, 3) a ray from the light of each (N, 3) meets solid points of the map on its last part."""
    ray, unused = np.empty(3), np.empty(0, np.int64)
    for index in range(len(points)):
        length = direct(lights[index], points[index], ray)
        n = normals[index]
        facing = max(-(n[0] * ray[0] + n[1] * ray[1] + n[2] * ray[2]), _LEAST_FACING)
        start, stop = max(length - _SHADOW_M, 0.0), length - _SHADOW_HEIGHT_M / facing
        _, in_the_way = cast(grid, columns, lights[index], ray, start, stop, _SHADOW_RADIUS_M, _LEAST_FACING, unused, 0)
        result[index] = in_the_way >= _SHADOW_WEIGHT
