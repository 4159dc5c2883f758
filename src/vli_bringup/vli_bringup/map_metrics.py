"""Map figures, as docs/evaluation defines them: distance to the true surface, completeness, colour.

All clouds are in the frame of the truth, metres. The surface is sampled, so that any tessellation gives the same figures.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from vli_bringup.trajectory_metrics import rms
from vli_common.arrays import BoolArray, ByteArray, FloatArray, IntArray

if TYPE_CHECKING:
    from scipy.spatial import KDTree

SPACING_M = 1e-4
REACH_M = 1e-3
NEAR_M = 5e-4
_CHUNK = 500_000
_SPLIT_RADIUS_M = 2e-3
_WORKERS = 2

Triangles: TypeAlias = FloatArray
"""(F, 3, 3) float64: corners of F triangles."""


@dataclass(frozen=True, slots=True)
class SurfaceDistances:
    """Distances (N,) of map points to the sampled surface, metres.

    Args:
        to_point: to the nearest sample; ``inf`` beyond 1 mm.
        to_plane: signed, along the normal of that sample's triangle; NaN beyond 1 mm.
    """

    to_point: FloatArray
    to_plane: FloatArray


@dataclass(frozen=True, slots=True)
class SurfaceFigures:
    """Map against surface; the field names are the keys of the JSON report, None where no point lies within 1 mm.

    Args:
        map_point_to_plane_rmse_mm, map_point_to_point_rmse_mm: over the points within 1 mm of the surface
            sampled at 0.1 mm. The second has a floor of some 0.05 mm: a perfect point's distance to the nearest sample.
        map_point_to_plane_median_mm: of the absolute values.
        beyond_0_5mm_percent, beyond_1mm_percent: share of all map points farther than that from the surface.
    """

    map_point_to_plane_rmse_mm: float | None
    map_point_to_point_rmse_mm: float | None
    map_point_to_plane_median_mm: float | None
    beyond_0_5mm_percent: float
    beyond_1mm_percent: float


@dataclass(frozen=True, slots=True)
class CompletenessFigures:
    """What the laser saw against the map; the field names are the keys of the JSON report.

    Args:
        completeness_percent: share of the seen points with a map point within 0.5 mm.
        colour_rmse: over these, seen colour against the colour of that map point, all channels, 1 = full scale.
        colour_rmse_red, colour_rmse_green, colour_rmse_blue: the same, channel by channel.
        colour_rmse_gain_compensated: ``colour_rmse`` after the best gain for each channel, so that exposure and white
            balance do not count.
    """

    completeness_percent: float
    colour_rmse: float | None = None
    colour_rmse_red: float | None = None
    colour_rmse_green: float | None = None
    colour_rmse_blue: float | None = None
    colour_rmse_gain_compensated: float | None = None


def _nearest(tree: KDTree, points: FloatArray, reach_m: float) -> tuple[FloatArray, IntArray]:
    """Return distance and index (N,) of the nearest point of the tree; ``inf`` and the tree's size beyond ``reach_m``."""
    distance, index = tree.query(points, distance_upper_bound=reach_m, workers=_WORKERS)
    return np.asarray(distance, dtype=np.float64), np.asarray(index, dtype=np.int64)


def near_triangles(triangles: Triangles, tree: KDTree, reach_m: float) -> Triangles:
    """Return triangles (K, 3, 3) that cover all of the surface within ``reach_m`` of the points of ``tree``, and little more.

    Large ones are split, so that a map that touches one corner of a wall does not ask for all of the wall.
    """
    kept = [np.empty((0, 3, 3))]
    while len(triangles):
        centres = triangles.mean(axis=1)
        radius = np.linalg.norm(triangles - centres[:, None], axis=2).max(axis=1)
        distance, _ = _nearest(tree, centres, reach_m + float(radius.max()) + SPACING_M)
        near = distance <= reach_m + radius
        small = radius <= _SPLIT_RADIUS_M
        kept.append(triangles[near & small])
        triangles = _split(triangles[near & ~small])
    return np.concatenate(kept)


def _split(triangles: Triangles) -> Triangles:
    """Return each triangle as the four that the middles of its edges make, (4 F, 3, 3), facing the same way."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    corners = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate([np.stack(three, axis=1) for three in corners])


def sample_surface(
    triangles: Triangles, tree: KDTree, reach_m: float = REACH_M, spacing_m: float = SPACING_M
) -> tuple[FloatArray, FloatArray]:
    """Return samples (S, 3) of the surface, one a ``spacing_m``², and the unit normals (S, 3) of their triangles.

    Even and repeatable: systematic over the cumulative area, and within a triangle by the R₂ sequence (Roberts, 2018). What is
    farther than ``reach_m`` from the points of ``tree`` is left out, chunk by chunk: memory follows the map, not the mesh.
    """
    triangles = near_triangles(triangles, tree, reach_m)
    edges = triangles[:, 1:] - triangles[:, :1]
    cross = np.cross(edges[:, 0], edges[:, 1])
    area2 = np.linalg.norm(cross, axis=1)
    normals = cross / np.where(area2 > 0, area2, 1.0)[:, None]
    cumulative = np.cumsum(area2 / 2)
    count = int(cumulative[-1] / spacing_m**2) if len(cumulative) else 0
    points, faces = [np.empty((0, 3))], [np.empty(0, dtype=np.int64)]
    for start in range(0, count, _CHUNK):
        index = np.arange(start, min(start + _CHUNK, count))
        face = np.searchsorted(cumulative, (index + 0.5) * spacing_m**2)
        sample = triangles[face, 0] + (edges[face] * _barycentric(index)[:, :, None]).sum(axis=1)
        distance, _ = _nearest(tree, sample, reach_m)
        near = np.isfinite(distance)
        points.append(sample[near])
        faces.append(face[near])
    return np.concatenate(points), normals[np.concatenate(faces)]


def _barycentric(index: IntArray) -> FloatArray:
    """Return (N, 2) coordinates along the two edges of a triangle: the R₂ sequence on the square, folded."""
    plastic = 1.3247179572447460
    uv = np.modf(0.5 + index[:, None] * np.array([1 / plastic, 1 / plastic**2]))[0]
    result: FloatArray = np.where(uv.sum(axis=1, keepdims=True) > 1, 1 - uv, uv)
    return result


def surface_distances(points: FloatArray, triangles: Triangles) -> SurfaceDistances:
    """Return the distances of map points (N, 3) to the surface (F, 3, 3), both in the frame of the truth."""
    from scipy.spatial import KDTree

    to_point, to_plane = np.full(len(points), np.inf), np.full(len(points), np.nan)
    if len(points) == 0:
        return SurfaceDistances(to_point, to_plane)
    samples, normals = sample_surface(triangles, KDTree(points))
    if len(samples) == 0:
        return SurfaceDistances(to_point, to_plane)
    to_point, nearest = _nearest(KDTree(samples), points, REACH_M)
    near = np.isfinite(to_point)
    to_plane[near] = np.einsum("ni,ni->n", points[near] - samples[nearest[near]], normals[nearest[near]])
    return SurfaceDistances(to_point, to_plane)


def surface_figures(distances: SurfaceDistances) -> SurfaceFigures:
    """Return the figures of N ≥ 1 map points."""
    near = np.isfinite(distances.to_point)
    beyond_near, beyond_reach = (100 * float((distances.to_point > limit).mean()) for limit in (NEAR_M, REACH_M))
    if not near.any():
        return SurfaceFigures(None, None, None, beyond_near, beyond_reach)
    to_plane, to_point = distances.to_plane[near], distances.to_point[near]
    median = float(np.median(np.abs(to_plane)))
    return SurfaceFigures(1e3 * rms(to_plane), 1e3 * rms(to_point), 1e3 * median, beyond_near, beyond_reach)


def nearest_map_points(seen: FloatArray, points: FloatArray) -> tuple[BoolArray, IntArray]:
    """Return where a map point (N, 3) lies within 0.5 mm of a seen point (M, 3), and the nearest one's index, both (M,)."""
    from scipy.spatial import KDTree

    if len(points) == 0:
        return np.zeros(len(seen), dtype=np.bool_), np.zeros(len(seen), dtype=np.int64)
    distance, index = _nearest(KDTree(points), seen, NEAR_M)
    return np.isfinite(distance), index


def completeness_figures(covered: BoolArray, colours: tuple[ByteArray, ByteArray] | None) -> CompletenessFigures:
    """Return completeness and, where both clouds have colour, the colour error.

    Args:
        covered: (M,), M ≥ 1, seen points with a map point near.
        colours: (C, 3) each, red green blue of the C covered seen points and of their nearest map points.
    """
    share = 100 * float(covered.mean())
    if colours is None or not covered.any():
        return CompletenessFigures(share)
    seen, mapped = (channels / 255.0 for channels in colours)
    error = mapped - seen
    power = (mapped**2).sum(axis=0)
    gain = (mapped * seen).sum(axis=0) / np.where(power > 0, power, 1.0)
    red, green, blue = (rms(channel) for channel in error.T)
    return CompletenessFigures(share, rms(error), red, green, blue, rms(gain * mapped - seen))
