"""The map: points with position, normal, colour and weight, found by place at a cost that does not grow with the map."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numba import njit

from vli_common.arrays import AnyArray, BoolArray, ByteArray, Float32Array, FloatArray, Int32Array, IntArray
from vli_common.types import PointCloud
from vli_mapping.config import MapConfig
from vli_mapping.normals import refine_normals
from vli_mapping.spatial_hash import SpatialHash, bucket_of, cell_of, link_one, unlink_one

CELL_M = 5e-4
UNKNOWN_COLOUR = 128
"""What a point shows that no long image saw."""
_GROWTH = 1.5


@dataclass
class Columns:
    """The arrays of a map, one row a point; rows beyond the map's length are room to grow.

    Args:
        position: (N, 3) float64, metres, map.
        normal: (N, 3) float32, unit, towards the sensor; 0 where none.
        colour: (N, 3) float32, RGB 0 … 255; NaN where no long image saw the point.
        weight: (N,) float32, points merged, capped.
        sigma: (N,) float32, metres, one standard deviation of the averaged position along the viewing ray.
        planarity: (N,) float32, see ``normals``.
        scan: (N,) int32, number of the scan that brought the point.
        entered_ns: (N,) int64, its stamp.
    """

    position: FloatArray
    normal: Float32Array
    colour: Float32Array
    weight: Float32Array
    sigma: Float32Array
    planarity: Float32Array
    scan: Int32Array
    entered_ns: IntArray

    @staticmethod
    def empty(capacity: int) -> Columns:
        """Return columns of undefined content."""
        narrow = np.float32
        return Columns(
            np.empty((capacity, 3)),
            np.empty((capacity, 3), narrow),
            np.empty((capacity, 3), narrow),
            np.empty(capacity, narrow),
            np.empty(capacity, narrow),
            np.empty(capacity, narrow),
            np.empty(capacity, np.int32),
            np.empty(capacity, np.int64),
        )

    def grow(self, capacity: int, count: int) -> None:
        """Make room for ``capacity`` rows, keeping the first ``count``."""
        for item in fields(self):
            old: AnyArray = getattr(self, item.name)
            new = np.empty((capacity, *old.shape[1:]), old.dtype)
            new[:count] = old[:count]
            setattr(self, item.name, new)


@dataclass(frozen=True, slots=True)
class Stripe:
    """One scan on its way into the map.

    Args:
        stamp_ns: of the scan.
        number: counts the scans of the session, ascending.
        viewpoint: (3,), camera centre in map.
        points: (N, 3), map, metres.
        normals: (N, 3) float32, 0 = none.
        planarity: (N,) float32.
        colours: (N, 3) float32 RGB, NaN = not seen.
        sigma: (N,), metres.
    """

    stamp_ns: int
    number: int
    viewpoint: FloatArray
    points: FloatArray
    normals: Float32Array
    planarity: Float32Array
    colours: Float32Array
    sigma: FloatArray

    def __len__(self) -> int:
        return len(self.points)


class PointMap:
    """Points that merge with near ones of compatible colour and normal, else are added.

    Positions are averaged by their sigmas, colours and normals by weight; the weight is capped, so that a point goes on following.

    Args:
        config: see :class:`MapConfig`.
        capacity: points to make room for at the start; it grows.
    """

    def __init__(self, config: MapConfig | None = None, capacity: int = 1 << 16) -> None:
        self.config = config or MapConfig()
        self.columns = Columns.empty(capacity)
        self.grid = SpatialHash(CELL_M, capacity)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def positions(self) -> FloatArray:
        """(N, 3) metres; a view, valid until the map grows."""
        return self.columns.position[: self._count]

    def insert(self, stripe: Stripe) -> IntArray:
        """Merge or add every point of a stripe; return the map point (N,) that each has become or joined."""
        self._reserve(self._count + len(stripe))
        c, config = self.columns, self.config
        target = np.empty(len(stripe), np.int64)
        self._count = _insert(
            self.grid.heads, self.grid.next, CELL_M, self._count,
            c.position, c.normal, c.colour, c.weight, c.sigma, c.planarity, c.scan, c.entered_ns,
            stripe.points, stripe.normals, stripe.colours, stripe.sigma, stripe.planarity, stripe.number, stripe.stamp_ns,
            config.merge_radius, np.cos(np.radians(config.merge_angle_deg)), config.merge_colour, config.max_weight, target,
        )  # fmt: skip
        return target

    def refine_normals(self, which: IntArray, viewpoint: FloatArray) -> None:
        """Fit the normals of points ``which`` (K,) again, to all the points that are near by now; new ones face ``viewpoint`` (3,)."""
        c, config = self.columns, self.config
        refine_normals(
            self.grid, c.position, which, viewpoint, config.normal_radius, config.min_planarity, c.normal, c.planarity
        )

    def cloud(self, which: IntArray | BoolArray | None = None, stamp_ns: int = 0, session: int = 0) -> PointCloud:
        """Return the map, or its points ``which``, as a cloud of its own memory."""
        chosen: AnyArray | slice = slice(None) if which is None else which
        c, n = self.columns, self._count
        return PointCloud(
            stamp_ns,
            c.position[:n][chosen].astype(np.float32),
            to_bytes(c.colour[:n][chosen]),
            c.normal[:n][chosen].copy(),
            c.weight[:n][chosen].copy(),
            session,
        )

    def thinned(self, max_points: int, stamp_ns: int = 0, session: int = 0) -> PointCloud:
        """Return at most ``max_points``: the heaviest point of each voxel, the voxel as small as that allows."""
        if self._count <= max_points:
            return self.cloud(stamp_ns=stamp_ns, session=session)
        which = thin(self.positions, self.columns.weight[: self._count], max_points)
        return self.cloud(which, stamp_ns, session)

    def _reserve(self, needed: int) -> None:
        if needed <= len(self.columns.weight):
            return
        capacity = max(needed, int(_GROWTH * len(self.columns.weight)))
        self.columns.grow(capacity, self._count)
        self.grid.reserve(capacity, self.columns.position, self._count)


def to_bytes(colours: Float32Array) -> ByteArray:
    """Return colours (N, 3) of 0 … 255 as uint8; mid-grey where NaN."""
    known = np.where(np.isnan(colours), np.float32(UNKNOWN_COLOUR), colours)
    return np.clip(np.rint(known), 0, 255).astype(np.uint8)


def thin(points: FloatArray, weights: Float32Array, max_points: int) -> IntArray:
    """Return indices (K ≤ max_points,), ascending: of each voxel the heaviest point, the first of equals.

    Args:
        points: (N, 3) metres.
        weights: (N,).
        max_points: the voxel's edge grows from the map's cell until so few remain.
    """
    edge = CELL_M / 2
    while len(kept := _heaviest(points, weights, edge)) > max_points:
        # Points lie on surfaces: their number falls with the square of the edge; never by less than a little.
        edge *= max(1.02, 0.98 * (len(kept) / max_points) ** 0.5)
    return kept


def _heaviest(points: FloatArray, weights: Float32Array, edge: float) -> IntArray:
    heads = SpatialHash(edge, len(points))
    kept = np.zeros(len(points), np.bool_)
    _mark_heaviest(heads.heads, heads.next, points, weights, edge, kept)
    return np.flatnonzero(kept)


@njit(cache=True)
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


@njit(cache=True)
def _insert(  # type: ignore[no-untyped-def]
    heads, following, cell_m, count,
    position, normal, colour, weight, sigma, planarity, scan, entered_ns,
    points, normals, colours, sigmas, planarities, number, stamp_ns,
    radius, min_cosine, max_colour, max_weight, target,
):  # fmt: skip
    for index in range(len(points)):
        p = points[index]
        at = _nearest_compatible(
            heads, following, cell_m, position, normal, colour, p, normals[index], colours[index], radius, min_cosine, max_colour
        )
        if at < 0:
            at = count
            count += 1
            position[at] = p
            normal[at] = normals[index]
            colour[at] = colours[index]
            weight[at] = 1.0
            sigma[at] = sigmas[index]
            planarity[at] = planarities[index]
            scan[at] = number
            entered_ns[at] = stamp_ns
            link_one(heads, following, at, p, cell_m)
        else:
            _merge(
                heads, following, cell_m, at, position, normal, colour, weight, sigma, p, normals[index], colours[index],
                sigmas[index], max_weight,
            )  # fmt: skip
        target[index] = at
    return count


@njit(cache=True)
def _nearest_compatible(  # type: ignore[no-untyped-def]
    heads, following, cell_m, position, normal, colour, p, n, c, radius, min_cosine, max_colour
):
    best = -1
    nearest = radius * radius
    for i in range(cell_of(p[0] - radius, cell_m), cell_of(p[0] + radius, cell_m) + 1):
        for j in range(cell_of(p[1] - radius, cell_m), cell_of(p[1] + radius, cell_m) + 1):
            for k in range(cell_of(p[2] - radius, cell_m), cell_of(p[2] + radius, cell_m) + 1):
                at = heads[bucket_of(i, j, k, len(heads))]
                while at >= 0:
                    q = position[at]
                    distance = (q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2 + (q[2] - p[2]) ** 2
                    if (
                        distance < nearest
                        and normals_agree(normal[at], n, min_cosine)
                        and colours_agree(colour[at], c, max_colour)
                    ):
                        best = at
                        nearest = distance
                    at = following[at]
    return best


@njit(cache=True)
def normals_agree(a, b, min_cosine):  # type: ignore[no-untyped-def]
    """Return True where two normals (3,) are within the angle, or one is unknown (0)."""
    if (a[0] == 0 and a[1] == 0 and a[2] == 0) or (b[0] == 0 and b[1] == 0 and b[2] == 0):
        return True
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] >= min_cosine


@njit(cache=True)
def colours_agree(a, b, limit):  # type: ignore[no-untyped-def]
    """Return True where two colours (3,) differ by at most ``limit`` in every channel, or one is unknown (NaN)."""
    for channel in range(3):
        if abs(a[channel] - b[channel]) > limit:
            return False
    return True


@njit(cache=True)
def _merge(  # type: ignore[no-untyped-def]
    heads, following, cell_m, at, position, normal, colour, weight, sigma, p, n, c, sigma_new, max_weight
):
    old_information, new_information = 1.0 / np.float64(sigma[at]) ** 2, 1.0 / np.float64(sigma_new) ** 2
    gain = new_information / (old_information + new_information)
    moved = np.empty(3)
    same = True
    for axis in range(3):
        moved[axis] = position[at, axis] + gain * (p[axis] - position[at, axis])
        same = same and cell_of(moved[axis], cell_m) == cell_of(position[at, axis], cell_m)
    if not same:
        unlink_one(heads, following, at, position[at], cell_m)
    position[at] = moved
    if not same:
        link_one(heads, following, at, moved, cell_m)
    share = 1.0 / (weight[at] + 1.0)
    _blend_normal(normal[at], n, share)
    for channel in range(3):
        if np.isnan(colour[at, channel]):
            colour[at, channel] = c[channel]
        elif not np.isnan(c[channel]):
            colour[at, channel] += share * (c[channel] - colour[at, channel])
    information = old_information + new_information
    merged = weight[at] + 1.0
    if merged > max_weight:
        information *= max_weight / merged
        merged = max_weight
    weight[at] = merged
    sigma[at] = 1.0 / np.sqrt(information)


@njit(cache=True)
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
