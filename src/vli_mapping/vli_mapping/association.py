"""Window-to-map correspondences, eq. (4): Σ w_i ((v_i^g − T v_i) · n_i^g)².

v_i is a point of a scan that is still in the window, v_i^g and n_i^g are centroid and normal of the plane through the map points
around the one that is nearest to T v_i. Held fixed for a solve: re-searching inside it would make the cost jump.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from vli_common.arrays import Float32Array, FloatArray, IntArray
from vli_common.geometry import transform
from vli_common.types import NANOSECONDS, Counters, MapConstraints
from vli_mapping.config import AssociationConfig
from vli_mapping.insertion import colours_agree, normals_agree
from vli_mapping.normals import MAX_NEIGHBOURS, fit_plane
from vli_mapping.point_map import PointMap
from vli_mapping.scan_window import PosedScan
from vli_mapping.spatial_hash import bucket_of, cell_of, coordinates, neighbours

_FULL_SUPPORT = 12.0
"""Map points of a plane from which on more do not make it weigh more."""
_REASONS = ("matched", "no_map_point", "too_young", "colour_differs", "no_plane", "normal_differs", "gated")


@dataclass(frozen=True, slots=True)
class _Queries:
    """The points that look for the map, (N,) or (N, 3) each: in the camera, in map, and what must agree."""

    stamps: IntArray
    numbers: IntArray
    points_camera: FloatArray
    points_map: FloatArray
    colours: Float32Array
    normals: Float32Array
    sigma: FloatArray


def associate(
    point_map: PointMap,
    scans: Sequence[PosedScan],
    stamp_ns: int,
    config: AssociationConfig,
    counters: Counters,
    session: int = 0,
) -> MapConstraints | None:
    """Return correspondences of the scans with the map, or None where there are too few to be trusted.

    Args:
        point_map: with the numbers of its scans counted as those of ``scans``.
        scans: of the window, not in the map yet.
        stamp_ns: newest keyframe of the window.
        config: see :class:`AssociationConfig`.
        counters: of what became of the points that looked for the map.
        session: of the window.
    """
    if not scans or len(point_map) == 0:
        return None
    queries = _gather(scans, config.points_per_scan)
    planes, outcome = _search(point_map, queries, config)
    for code, reason in enumerate(_REASONS):
        counters.add(f"constraints_{reason}", int((outcome == code).sum()))
    found = outcome == 0
    if found.sum() < config.min_constraints:
        return None
    planes = planes[found]
    return MapConstraints(
        stamp_ns=stamp_ns,
        scan_stamps=queries.stamps[found],
        points_camera=queries.points_camera[found],
        points_map=planes[:, :3],
        normals_map=planes[:, 3:6],
        sigma=np.hypot(config.sigma_floor, np.hypot(planes[:, 6], queries.sigma[found])),
        weight=planes[:, 7],
        session=session,
    )


def _gather(scans: Sequence[PosedScan], count: int) -> _Queries:
    """Return some ``count`` points of each scan, where they are believed to be now."""
    probes = [item.probe(count) for item in scans]
    sizes = [len(probe.points) for probe in probes]
    T_map_camera = np.repeat(np.stack([item.T_map_camera for item in scans]), sizes, axis=0)
    points = np.concatenate([probe.points for probe in probes])
    normals = np.concatenate([probe.normals for probe in probes])
    return _Queries(
        stamps=np.repeat([item.scan.stamp_ns for item in scans], sizes),
        numbers=np.repeat([item.number for item in scans], sizes),
        points_camera=points,
        points_map=transform(T_map_camera, points),
        colours=np.concatenate([probe.colours for probe in probes]),
        normals=np.einsum("nij,nj->ni", T_map_camera[:, :3, :3], normals).astype(np.float32),
        sigma=np.concatenate([probe.sigma for probe in probes]),
    )


def _search(point_map: PointMap, queries: _Queries, config: AssociationConfig) -> tuple[FloatArray, IntArray]:
    """Return planes (N, 8) and outcomes (N,), see ``_search_planes``."""
    c, limits = point_map.columns, point_map.config
    planes, outcome = np.empty((len(queries.stamps), 8)), np.empty(len(queries.stamps), np.int64)
    _search_planes(
        (point_map.grid.heads, point_map.grid.next, point_map.grid.cell_m),
        (c.position, c.normal, c.colour, c.scan, c.entered_ns, c.sigma, c.solid),
        (queries.points_map, queries.colours, queries.normals),
        queries.numbers - config.min_age_scans,
        queries.stamps - int(config.min_age_s * NANOSECONDS),
        (config.gate, config.max_colour, np.cos(np.radians(config.max_angle_deg)), limits.normal_radius, limits.min_planarity),
        config.min_neighbours,
        planes,
        outcome,
    )
    return planes, outcome


@njit(cache=True, nogil=True)
def _search_planes(  # type: ignore[no-untyped-def]
    grid, columns, queries, newest_scan, newest_ns, limits, min_neighbours, planes, outcome
):
    """For each query write the plane (centroid, normal, sigma, weight) it corresponds to, and the index into ``_REASONS``."""
    heads, following, cell_m = grid
    position, normal, colour, scan, entered_ns, sigma, solid = columns
    points, colours, normals = queries
    gate, max_colour, min_cosine, radius, min_planarity = limits
    found = np.empty(MAX_NEIGHBOURS, np.int64)
    fit = np.empty(8)
    for index in range(len(points)):
        p = points[index]
        nearest, seen = _nearest_old(
            heads, following, cell_m, position, scan, entered_ns, solid, p, newest_scan[index], newest_ns[index], gate
        )
        if nearest < 0:
            outcome[index] = 2 if seen else 1
            continue
        if not colours_agree(colour[nearest], colours[index], max_colour):
            outcome[index] = 3
            continue
        count = neighbours(heads, following, position, position[nearest], radius, cell_m, found)
        old = 0
        for at in found[:count]:
            if solid[at] and scan[at] <= newest_scan[index] and entered_ns[at] <= newest_ns[index]:
                found[old] = at
                old += 1
        fit_plane(position, found[:old], position[nearest], fit)
        if old < min_neighbours or fit[6] < min_planarity:
            outcome[index] = 4
            continue
        _turn(fit, normal[nearest])
        if not normals_agree(fit[3:6], normals[index], min_cosine):
            outcome[index] = 5
            continue
        distance = fit[3] * (fit[0] - p[0]) + fit[4] * (fit[1] - p[1]) + fit[5] * (fit[2] - p[2])
        if abs(distance) > gate:
            outcome[index] = 6
            continue
        outcome[index] = 0
        planes[index, :6] = fit[:6]
        planes[index, 6] = max(fit[7], np.float64(sigma[nearest])) / np.sqrt(old)
        planes[index, 7] = (fit[6] - min_planarity) / (1 - min_planarity) * min(1.0, old / _FULL_SUPPORT)


@njit(cache=True, nogil=True)
def _turn(plane, normal):  # type: ignore[no-untyped-def]
    """Turn the normal of a fitted plane to the side of the map point's, so that the far side of a thin wall does not agree."""
    if plane[3] * normal[0] + plane[4] * normal[1] + plane[5] * normal[2] < 0:
        plane[3:6] *= -1.0


@njit(cache=True, nogil=True)
def _nearest_old(  # type: ignore[no-untyped-def]
    heads, following, cell_m, position, scan, entered_ns, solid, p, newest_scan, newest_ns, gate
):
    """Return the nearest point within ``gate`` that is old enough (or −1), and whether any point was within it.

    Shells of cells from the inside out: one is the last where what it holds is nearer than the next can be.
    """
    centre = (cell_of(p[0], cell_m), cell_of(p[1], cell_m), cell_of(p[2], cell_m))
    best = -1
    nearest = gate * gate
    seen = False
    for shell in range(int(np.ceil(gate / cell_m)) + 1):
        if shell >= 1 and nearest <= ((shell - 1) * cell_m) ** 2:
            break
        for i in range(-shell, shell + 1):
            for j in range(-shell, shell + 1):
                face = abs(i) == shell or abs(j) == shell
                step = 1 if face or shell == 0 else 2 * shell
                for k in range(-shell, shell + 1, step):
                    at = heads[bucket_of(centre[0] + i, centre[1] + j, centre[2] + k, len(heads))]
                    while at >= 0:
                        q = coordinates(position, at)
                        distance = (q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2 + (q[2] - p[2]) ** 2
                        if distance <= nearest:
                            seen = True
                            if solid[at] and scan[at] <= newest_scan and entered_ns[at] <= newest_ns:
                                best = at
                                nearest = distance
                        at = following[at]
    return best, seen
