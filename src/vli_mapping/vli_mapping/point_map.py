"""The map: points with position, normal, colour and weight, found by place at a cost that does not grow with the map."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from vli_common.arrays import AnyArray, BoolArray, ByteArray, Float32Array, FloatArray, Int32Array, IntArray
from vli_common.types import PointCloud
from vli_mapping.allocation import Allocate, in_memory
from vli_mapping.config import MapConfig
from vli_mapping.insertion import FREE, ROWS, insert_stripe, remove
from vli_mapping.keyframe import MapKeyframe
from vli_mapping.light import Light
from vli_mapping.normals import refine_normals, smooth_normals
from vli_mapping.pieces import Pieces
from vli_mapping.spatial_hash import NONE, SpatialHash, link
from vli_mapping.thinning import thin

CELL_M = 8e-4
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
        weight: (N,) float32, points merged, capped; 0 in a row whose point has left.
        sigma: (N,) float32, metres, one standard deviation of the averaged position along the viewing ray.
        planarity: (N,) float32, see ``normals``.
        scan: (N,) int32, number of the scan that brought the point.
        seen_by: (N,) int32, number of the scan whose long images gave the colour: of several visits that with the best view.
        entered_ns: (N,) int64, its stamp.
        solid: (N,) bool, False for a point that stays only until something better covers its place.
        albedo: (N, 3) float32, RGB under the reference light as photographs have shown it, see ``photographs``.
        albedo_weight: (N,) float32, of it, Σ E²; 0 where none has.
        albedo_power: (N,) float32, Σ of the squared grey levels that it is of.
    """

    position: FloatArray
    normal: Float32Array
    colour: Float32Array
    weight: Float32Array
    sigma: Float32Array
    planarity: Float32Array
    scan: Int32Array
    seen_by: Int32Array
    entered_ns: IntArray
    solid: BoolArray
    albedo: Float32Array
    albedo_weight: Float32Array
    albedo_power: Float32Array

    @staticmethod
    def empty(capacity: int, allocate: Allocate = in_memory) -> Columns:
        """Return columns of undefined content."""
        narrow = np.float32
        return Columns(
            allocate((capacity, 3), np.float64),
            allocate((capacity, 3), narrow),
            allocate((capacity, 3), narrow),
            allocate((capacity,), narrow),
            allocate((capacity,), narrow),
            allocate((capacity,), narrow),
            allocate((capacity,), np.int32),
            allocate((capacity,), np.int32),
            allocate((capacity,), np.int64),
            allocate((capacity,), np.bool_),
            allocate((capacity, 3), narrow),
            allocate((capacity,), narrow),
            allocate((capacity,), narrow),
        )

    def grow(self, capacity: int, count: int, allocate: Allocate = in_memory) -> None:
        """Make room for ``capacity`` rows, keeping the first ``count``."""
        for item in fields(self):
            old: AnyArray = getattr(self, item.name)
            new = allocate((capacity, *old.shape[1:]), old.dtype)
            new[:count] = old[:count]
            setattr(self, item.name, new)

    def at(self, rows: IntArray | slice) -> Columns:
        """Return some of the rows; of a slice no copy is made."""
        return Columns(*(getattr(self, item.name)[rows] for item in fields(self)))


@dataclass(frozen=True, slots=True)
class Stripe:
    """One scan on its way into the map.

    Args:
        stamp_ns: of the scan.
        number: counts the scans of the session, ascending.
        T_map_camera: (4, 4), its pose.
        points: (N, 3), map, metres.
        normals: (N, 3) float32, 0 = none.
        planarity: (N,) float32.
        colours: (N, 3) float32 RGB, NaN = not seen.
        sigma: (N,), metres.
        solid: (N,) bool, False for points that may fly, see ``entry``.
    """

    stamp_ns: int
    number: int
    T_map_camera: FloatArray
    points: FloatArray
    normals: Float32Array
    planarity: Float32Array
    colours: Float32Array
    sigma: FloatArray
    solid: BoolArray

    def __len__(self) -> int:
        return len(self.points)

    @property
    def viewpoint(self) -> FloatArray:
        """Camera centre (3,) in map."""
        viewpoint: FloatArray = self.T_map_camera[:3, 3]
        return viewpoint


class PointMap:
    """Points that merge with near ones of compatible colour and normal, else are added.

    Positions are averaged by their sigmas, normals by weight, colours too within one visit; the weight is capped, so that a
    point goes on following. Doubtful points only fill what no solid point covers, and leave when one does: the rows of points
    that left (weight 0) are used again.

    Args:
        config: see :class:`MapConfig`.
        capacity: points to make room for at the start; it grows.
        allocate: where the columns are kept.
    """

    def __init__(self, config: MapConfig | None = None, capacity: int = 1 << 16, allocate: Allocate = in_memory) -> None:
        self.config = config or MapConfig()
        self.columns, self._allocate = Columns.empty(capacity, allocate), allocate
        self.grid = SpatialHash(CELL_M, capacity)
        self.views: FloatArray = np.zeros((0, 3, 4))
        """(S, 3, 4), pose of the camera in map by the number of the scan."""
        self.keyframes: list[MapKeyframe] = []
        """Views by which a scanner finds its way back, in order of time."""
        self._state = np.array([0, NONE, 0], np.int64)
        self._pieces = Pieces(capacity, allocate)
        c = self.config
        self._limits = (
            c.merge_radius, float(np.cos(np.radians(c.merge_angle_deg))), c.merge_colour, c.max_weight, c.fill_radius
        )  # fmt: skip

    def __len__(self) -> int:
        return int(self._state[ROWS] - self._state[FREE])

    @property
    def rows(self) -> int:
        """Rows of ``columns`` in use, points that left included."""
        return int(self._state[ROWS])

    def alive(self, which: IntArray | None = None) -> IntArray:
        """Return the rows (K,) that hold a point: all of them, or those among ``which``."""
        weight = self.columns.weight
        if which is None:
            return np.flatnonzero(weight[: self.rows] > 0)
        return which[weight[which] > 0]

    def insert(self, stripe: Stripe) -> IntArray:
        """Take a stripe, solid points first; return the row (N,) each point became or joined, −1 where it was not needed."""
        self._reserve(self.rows + len(stripe))
        c = self.columns
        self._keep_view(stripe)
        target = np.empty(len(stripe), np.int64)
        insert_stripe(
            self.grid.heads,
            self.grid.next,
            CELL_M,
            self._state,
            tuple(getattr(c, item.name) for item in fields(c)),
            self.views,
            (stripe.points, stripe.normals, stripe.colours, stripe.sigma, stripe.planarity, stripe.solid),
            stripe.number,
            stripe.stamp_ns,
            self._limits,
            target,
        )
        seen = (stripe.points, stripe.points - stripe.viewpoint, stripe.sigma, stripe.number)
        self._pieces.join(self.grid, (c.position, c.scan), seen, target)
        return target

    def add_weight(self, target: IntArray, more: Float32Array) -> None:
        """Let points count for ``more`` (N,) than one; ``target`` (N,) is what ``insert`` said of them."""
        there = target >= 0
        weight = self.columns.weight
        np.add.at(weight, target[there], more[there])
        np.minimum(weight, np.float32(self.config.max_weight), out=weight, where=weight > 0)

    def add_albedo(self, target: IntArray, others: Columns) -> None:
        """Let points know the albedo of ``others`` (N rows) as well; ``target`` (N,) is what ``insert`` said of these."""
        c, told = self.columns, (target >= 0) & (others.albedo_weight > 0)
        rows, which = np.unique(target[told], return_inverse=True)
        weight = others.albedo_weight[told]
        total = np.column_stack([np.bincount(which, weight * column) for column in others.albedo[told].T])
        old = c.albedo_weight[rows, None]
        new = old + np.bincount(which, weight)[:, None]
        c.albedo[rows] = (old * c.albedo[rows] + total) / new
        c.albedo_weight[rows] = new[:, 0]
        c.albedo_power[rows] += np.bincount(which, others.albedo_power[told])

    def halve(self, which: IntArray) -> int:
        """Halve the weight of rows ``which`` (K,), each once; doubtful ones, and those with one or less, leave; say how many."""
        c = self.columns
        which = self.alive(which)
        c.weight[which] *= np.float32(0.5)
        c.sigma[which] *= np.float32(np.sqrt(2.0))
        gone = which[(c.weight[which] <= 1.0) | ~c.solid[which]]
        self.remove(gone)
        return len(gone)

    def remove_with(self, rows: IntArray, seen: FloatArray, number: int) -> int:
        """Let the rest of the pieces leave that lost too much with those of ``rows`` (K,) that have just left; say how many do.

        Args:
            rows: contradicted, see :meth:`halve`; some of them several times.
            seen: (K, 3), what was seen there instead.
            number: of the scan.
        """
        c = self.columns
        columns = c.position, c.weight, c.scan
        return self._pieces.leave(self.grid, self._state, columns, (rows, seen, number), self.config.piece_share)

    def remove(self, which: IntArray) -> None:
        """Let the points of rows ``which`` (K,), all of which hold one, leave."""
        c = self.columns
        remove(self.grid.heads, self.grid.next, CELL_M, self._state, c.position, c.weight, which)

    def refine_normals(self, which: IntArray, viewpoint: FloatArray) -> None:
        """Fit the normals of rows ``which`` (K,) again, to all that is near by now; new ones face ``viewpoint`` (3,)."""
        c, config = self.columns, self.config
        refine_normals(
            self.grid, c.position, self.alive(which), viewpoint, config.normal_radius, config.min_planarity, c.normal, c.planarity
        )

    def cloud(
        self,
        which: IntArray | None = None,
        stamp_ns: int = 0,
        session: int = 0,
        light: Light | None = None,
        as_seen: bool = False,
    ) -> PointCloud:
        """Return the map, or rows ``which`` of it, as a cloud of its own memory; see ``shown_colours``."""
        which = self.alive() if which is None else which
        c = self.columns
        colours = to_bytes(self.shown_colours(which, light, as_seen))
        return PointCloud(stamp_ns, c.position[which].astype(np.float32), colours, c.normal[which], c.weight[which], session)

    def thinned(
        self, max_points: int, stamp_ns: int = 0, session: int = 0, light: Light | None = None, as_seen: bool = False
    ) -> PointCloud:
        """Return at most ``max_points``: the heaviest point of each voxel, the voxel as small as that allows."""
        which = self.alive()
        if len(which) > max_points:
            which = which[thin(self.columns.position[which], self.columns.weight[which], max_points)]
        return self.cloud(which, stamp_ns, session, light, as_seen)

    def shown_colours(self, which: IntArray, light: Light | None, as_seen: bool) -> Float32Array:
        """Return the colours (K, 3) of rows ``which``, each by itself; NaN = unknown. For a finished map see ``albedo``.

        Args:
            which: rows.
            light: None leaves the colours as they are in the images.
            as_seen: take out only what the lens does to the light, not what the light does to the surface.
        """
        c = self.columns
        if light is None or not len(which):
            return c.colour[which]
        view = self.views[c.seen_by[which]]
        points = np.einsum("nji,nj->ni", view[:, :, :3], c.position[which] - view[:, :, 3])
        if as_seen:
            gain = light.vignette(points)
        else:
            normals = smooth_normals(self.grid, c.position, c.normal, which, self.config.normal_radius)
            gain = light.shading(points, np.einsum("nji,nj->ni", view[:, :, :3], normals))
        result: Float32Array = (c.colour[which] / gain[:, None]).astype(np.float32)
        return result

    def fill(self, columns: Columns, views: FloatArray) -> None:
        """Take the points of other columns, all rows of which hold one, into a map that is empty, as they are."""
        count = len(columns.weight)
        self._reserve(count)
        for item in fields(columns):
            getattr(self.columns, item.name)[:count] = getattr(columns, item.name)
        link(self.grid.heads, self.grid.next, self.columns.position, 0, count, CELL_M)
        self._state[ROWS] = count
        self.views = views.copy()

    def _keep_view(self, stripe: Stripe) -> None:
        if stripe.number >= len(self.views):
            grown = np.zeros((max(2 * len(self.views), stripe.number + 1, 256), 3, 4))
            grown[: len(self.views)] = self.views
            self.views = grown
        self.views[stripe.number] = stripe.T_map_camera[:3]

    def _reserve(self, needed: int) -> None:
        if needed <= len(self.columns.weight):
            return
        capacity = max(needed, int(_GROWTH * len(self.columns.weight)))
        self.columns.grow(capacity, self.rows, self._allocate)
        self.grid.reserve(capacity, self.columns.position, self.columns.weight[: self.rows] > 0)
        self._pieces.reserve(capacity)


def to_bytes(colours: Float32Array) -> ByteArray:
    """Return colours (N, 3) of 0 … 255 as uint8; mid-grey where NaN."""
    known = np.where(np.isnan(colours), np.float32(UNKNOWN_COLOUR), colours)
    return np.clip(np.rint(known), 0, 255).astype(np.uint8)
