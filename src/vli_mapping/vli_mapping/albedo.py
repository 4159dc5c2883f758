"""Colours of a finished map without the light on board: what single points do not tell, their neighbourhood does.

A point's albedo is what the images around its stripe and all photographs of it say together, ρ = Σ c E / Σ E² (``photographs``).
Its error is that of the shading E. On a flank, an error δ of the normal is one of tan β · δ; on an edge the normal itself means
little; in a shadow the light is something else altogether. So the normals of E are means over the neighbours on the same face,
and points that others keep from the light are found. What is left is told by views that do not agree (misfit), and by normals
that scatter. Both are taken over the neighbourhood: light is smooth over a face, and where only a few neighbours do not agree it
is print, which pixels that are off by one show lighter here and darker there.

A neighbourhood has a level, the mean over the face, and details, which differ from it. Where the light is doubted, the level is
drawn towards that of all around that is doubted less, by one factor for the whole face: print keeps its contrast. The details
keep the share V / (V + V₀), V their variance and V₀ that of their error: the best linear estimate (after Lee, "Digital image
enhancement and noise filtering by use of local statistics", 1980), but that V has the error in it and so errs on the side of
detail. Points that may fly, that have no normal or that the light does not reach take the colour around instead. Where all around
is doubted, the nearest that is trusted counts to it (``trusted_colours``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from vli_common.arrays import BoolArray, Float32Array, FloatArray, IntArray
from vli_common.types import PointCloud
from vli_mapping.light import Light
from vli_mapping.normals import MAX_NEIGHBOURS, SPARSE
from vli_mapping.point_map import PointMap, to_bytes
from vli_mapping.ray_casting import cast, direct
from vli_mapping.spatial_hash import SpatialHash, coordinates, neighbours
from vli_mapping.trusted_colours import from_afar

_REACH = 2.0
"""Times the radius of the normals: the neighbourhood."""
_SAME_FACE = float(np.cos(np.radians(40.0)))
"""Cosine between normals of one face: nearer than the flank of a key is to its top."""
_NOISE = 2.0
"""Grey levels, one standard deviation of a pixel."""
_MISFIT, _CURVED = 4.0, 0.4
"""Variance of a detail's error, as a share of the squared level: per misfit, and per unit of the tan² that the scatter of the
normals around comes to."""
_LEAST_MISFIT = 3e-4
"""It is the noise of the images that makes less."""
_MISFIT_DOUBT, _CURVED_DOUBT = 200.0, 2.0
"""Doubt of a level, likewise; a level of doubt d keeps the share 1 / (1 + d)."""
_UNLIT = 0.1
"""Doubt of a neighbour that has been in the light of the reference once: nothing contradicts what a single view shows."""
_MOST_GAIN = 4.0
"""Of the factor that draws a level, or the least as its inverse."""
_LEAST_WEIGHT = 1e-3
_ROUGH, _SHADOWED = 4.0, 10.0
"""Doubt of a point that has no normal of its own or may fly, and of one that the light does not reach."""
_LEAST = 0.02
"""Doubt of the best neighbour: one alone is no better than several."""
_LEAST_AGREEMENT = 0.1
_TRUST_AFAR = 1.0
"""Of all that the nearest trusted points say: a neighbourhood with any good point has more of its own."""
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
    views = _Views.empty(len(which))
    for start in range(0, len(which), _CHUNK):
        part = slice(start, start + _CHUNK)
        views.fill(part, point_map, light, which[part], normals[part])
    rough = (~c.normal[which].any(axis=1)).astype(np.float32) + ~c.solid[which]
    doubt = _ROUGH * rough + _SHADOWED * views.shadowed.astype(np.float32)
    return around.blend(normals, views, 1.0 / agreement**2 - 1.0, doubt)


def mean_normals(point_map: PointMap, which: IntArray) -> Float32Array:
    """Return the normals (K, 3) of the faces that rows ``which`` of a map are on, 0 where none is known."""
    return _neighbourhood(point_map, which).mean_normals(point_map.columns.normal[which])[0]


@dataclass(frozen=True, slots=True)
class _Views:
    """What all views of points say.

    Args:
        colours: (N, 3), albedo; NaN = unknown.
        weight: (N,), Σ E².
        misfit: (N,), how badly the views agree, 0 … 1.
        shadowed: (N,), whether the map keeps the light off.
    """

    colours: Float32Array
    weight: Float32Array
    misfit: Float32Array
    shadowed: BoolArray

    @staticmethod
    def empty(count: int) -> _Views:
        """Return room for so many points."""
        narrow = np.float32
        return _Views(np.empty((count, 3), narrow), np.empty(count, narrow), np.empty(count, narrow), np.empty(count, np.bool_))

    def fill(self, part: slice, point_map: PointMap, light: Light, which: IntArray, normals: Float32Array) -> None:
        """Fill a part of the rows, that of rows ``which`` (K,) of a map on faces of normals (K, 3)."""
        c = point_map.columns
        shading, self.shadowed[part] = light_on(point_map, light, which, normals)
        seen, known = ~np.isnan(c.colour[which, 0]), c.albedo_weight[which].astype(np.float64)
        colour, shading = np.where(seen[:, None], c.colour[which], 0.0), np.where(seen, shading, 0.0)
        weight = known + shading**2
        total = c.albedo[which] * known[:, None] + colour * shading[:, None]
        power = c.albedo_power[which] + colour.mean(axis=1) ** 2
        with np.errstate(invalid="ignore", divide="ignore"):
            self.colours[part] = total / weight[:, None]
            misfit = np.nan_to_num(1.0 - total.mean(axis=1) ** 2 / (weight * power), posinf=0.0, neginf=0.0)
        self.weight[part], self.misfit[part] = np.maximum(weight, _LEAST_WEIGHT), np.maximum(misfit, 0.0)


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
        self._points, sparse = points, np.ascontiguousarray(points[::SPARSE])
        grid = SpatialHash.of(sparse, radius)
        self._around = (grid.heads, grid.next, grid.cell_m, sparse, radius)

    def mean_normals(self, normals: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Return the mean normal (N, 3) of the face that each point is on, 0 where none is known, and the agreement (N,).

        That is the length of the sum over the number of all normals (N, 3) around; those of other faces are not in the sum.
        """
        mean, agreement = np.empty_like(normals), np.empty(len(normals), np.float32)
        _average_normals(self._around, self._points, normals, mean, agreement)
        return mean, agreement

    def blend(self, normals: Float32Array, views: _Views, scatter: Float32Array, doubt: Float32Array) -> Float32Array:
        """Return the colours (N, 3) of views, levels and details drawn as the module says.

        Args:
            normals: (N, 3), of the faces.
            views: of all points.
            scatter: (N,), tan² of the normals around.
            doubt: (N,), of the point itself.
        """
        misfit, result = np.empty_like(views.misfit), np.empty_like(views.colours)
        _pool(self._around, self._points, normals, views.misfit, misfit)
        in_level = _MISFIT_DOUBT * misfit + _CURVED_DOUBT * scatter
        # As a neighbour, a point is asked for its colour, and there may be better ones: whatever it is that spoils it.
        trust = 1.0 / (in_level + _MISFIT_DOUBT * views.misfit + _UNLIT / views.weight + doubt + _LEAST)
        error = _MISFIT * misfit + _CURVED * scatter
        shown = (views.colours, views.weight, views.shadowed)
        far = from_afar(self._points, views.colours, trust)
        _blend(self._around, self._points, normals, shown, (in_level, doubt, trust, error), far, result)
        return result


@njit(cache=True, nogil=True)
def _is_same_face(first, second):  # type: ignore[no-untyped-def]
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2] >= _SAME_FACE


@njit(cache=True, nogil=True)
def _average_normals(around, points, normals, mean, agreement):  # type: ignore[no-untyped-def]
    heads, following, cell_m, sparse, radius = around
    found = np.empty(MAX_NEIGHBOURS, np.int64)
    for index in range(len(points)):
        count = neighbours(heads, following, sparse, coordinates(points, index), radius, cell_m, found)
        own, known = coordinates(normals, index), 0
        # A point counts for itself: it may be none of the sparse ones.
        x, y, z = np.float64(own[0]), np.float64(own[1]), np.float64(own[2])
        has_own = x != 0 or y != 0 or z != 0
        if has_own:
            known = 1
        for at in found[:count]:
            n = coordinates(normals, SPARSE * at)
            if n[0] == 0 and n[1] == 0 and n[2] == 0:
                continue
            known += 1
            if not has_own or _is_same_face(own, n):
                x += n[0]
                y += n[1]
                z += n[2]
        length = np.sqrt(x * x + y * y + z * z)
        scale = 1.0 / length if length > 0 else 0.0
        mean[index, 0], mean[index, 1], mean[index, 2] = x * scale, y * scale, z * scale
        agreement[index] = max(length / max(known, 1), _LEAST_AGREEMENT)


@njit(cache=True, nogil=True)
def _pool(around, points, normals, misfit, result):  # type: ignore[no-untyped-def]
    """Take the geometric mean of the misfits (N,) on the same face: what is wrong with the light is wrong at all of them."""
    heads, following, cell_m, sparse, radius = around
    found = np.empty(MAX_NEIGHBOURS, np.int64)
    for index in range(len(points)):
        count = neighbours(heads, following, sparse, coordinates(points, index), radius, cell_m, found)
        own, total, beside = coordinates(normals, index), np.log(misfit[index] + _LEAST_MISFIT), 1
        for found_at in found[:count]:
            at = SPARSE * found_at
            if at != index and _is_same_face(own, coordinates(normals, at)):
                total += np.log(misfit[at] + _LEAST_MISFIT)
                beside += 1
        result[index] = max(np.exp(total / beside) - _LEAST_MISFIT, 0.0)


@njit(cache=True, nogil=True)
def _blend(around, points, normals, shown, doubts, far, result):  # type: ignore[no-untyped-def]
    heads, following, cell_m, sparse, radius = around
    colours, weight, _ = shown
    in_level, doubt, trust, error = doubts
    found, face, all_around = np.empty(MAX_NEIGHBOURS, np.int64), np.empty(3), np.empty(3)
    for index in range(len(points)):
        result[index] = colours[index]
        if np.isnan(colours[index, 0]):
            continue
        count = neighbours(heads, following, sparse, coordinates(points, index), radius, cell_m, found)
        trusts, variance = _look_around(index, found, count, normals, shown, trust, face, all_around)
        if not np.isnan(far[index, 0]):
            for channel in range(3):
                total = trusts * all_around[channel] + _TRUST_AFAR * far[index, channel]
                all_around[channel] = total / (trusts + _TRUST_AFAR)
        elif trusts == 0.0:
            continue
        level = face.mean()
        detail = variance / (variance + _NOISE**2 / weight[index] + error[index] * level * level)
        gain = min(max(all_around.mean() / max(level, 1e-3), 1.0 / _MOST_GAIN), _MOST_GAIN)
        scale = 1.0 + (gain - 1.0) * in_level[index] / (1.0 + in_level[index])
        share = 1.0 / (1.0 + doubt[index])
        for channel in range(3):
            drawn = scale * (face[channel] + detail * (colours[index, channel] - face[channel]))
            result[index, channel] = share * drawn + (1.0 - share) * all_around[channel]


@njit(cache=True, nogil=True)
def _look_around(index, found, count, normals, shown, trust, face, all_around):  # type: ignore[no-untyped-def]
    """Fill the means (3,) of the face that a point is on and of all around it; return the trust in these, and the variance on it.

    Args:
        index: of the point.
        found, count: its neighbours among the sparse points.
        normals: (N, 3).
        shown: colours (N, 3), weight (N,), shadowed (N,).
        trust: (N,), by which all around are weighed.
        face, all_around: the answer; the first, and the variance of its grey levels, with the point itself.
    """
    colours, _, shadowed = shown
    own, grey = coordinates(normals, index), _grey(colours, index)
    trusts, alike, square = 0.0, 1, grey * grey
    for channel in range(3):
        face[channel], all_around[channel] = colours[index, channel], 0.0
    for found_at in found[:count]:
        at = SPARSE * found_at
        if np.isnan(colours[at, 0]):
            continue
        trusts += trust[at]
        is_alike = at != index and shadowed[at] == shadowed[index] and _is_same_face(own, coordinates(normals, at))
        for channel in range(3):
            all_around[channel] += trust[at] * colours[at, channel]
            if is_alike:
                face[channel] += colours[at, channel]
        if is_alike:
            alike += 1
            square += _grey(colours, at) ** 2
    face /= alike
    all_around /= max(trusts, 1e-9)
    return trusts, max(square / alike - face.mean() ** 2, 0.0)


@njit(cache=True, nogil=True)
def _grey(colours, index):  # type: ignore[no-untyped-def]
    return (np.float64(colours[index, 0]) + colours[index, 1] + colours[index, 2]) / 3.0


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
