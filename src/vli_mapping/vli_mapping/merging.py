"""Several saved maps as one: each is aligned to what the others make up so far, and its points enter like those of a scan.

Points stay where they were allocated, on the disk if need be; what is made of them in memory is thinned, or a piece at a time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from vli_common.arrays import FloatArray, Int32Array, IntArray
from vli_common.errors import InputError
from vli_common.geometry import transform
from vli_mapping.allocation import Allocate, in_memory
from vli_mapping.config import MapConfig
from vli_mapping.light import Light
from vli_mapping.point_map import Columns, PointMap, Stripe
from vli_mapping.registration import ICP_VOXEL_M, Registration, Surface, register, surface_of
from vli_mapping.snapshot import Snapshot, restore, view
from vli_mapping.thinning import thin_to_voxel

_CHUNK_ROWS = 1 << 17
"""Points that are brought into another light, or thinned, at a time."""


def merge_maps(
    maps: Iterable[Snapshot], config: MapConfig | None = None, allocate: Allocate = in_memory
) -> tuple[Snapshot, list[Registration]]:
    """Return one map in the frame of the first, and how each of the others lay in it.

    Args:
        maps: at least one; each shares a part with those before it. They are taken one after another.
        config: of the map that results.
        allocate: where its points are kept.

    Raises:
        InputError: a map shares too little with those before it, or fits in more than one way.
    """
    rest = iter(maps)
    first = next(rest)
    whole, light = restore(first, config, allocate), first.light
    del first
    registrations = []
    for number, snapshot in enumerate(rest, start=2):
        try:
            found = register(surface_of_map(view(whole, light)), surface_of_map(snapshot))
        except InputError as error:
            raise InputError(f"map '{number}' does not join those before it: {error}") from error
        join(whole, snapshot, found.T_target_source, light)
        registrations.append(found)
    return view(whole, light), registrations


def join(whole: PointMap, snapshot: Snapshot, T_whole_snapshot: FloatArray, light: Light | None) -> None:
    """Enter the points of a map into another of some ``light``, scan by scan as they were seen, with their weights."""
    first = len(whole.views)
    for rows in _whole_scans(snapshot.columns.seen_by):
        part = relit(replace(snapshot, columns=snapshot.columns.at(rows), keyframes=()), light)
        starts = np.flatnonzero(np.diff(part.columns.seen_by, prepend=-1))
        for scan in np.split(np.arange(len(rows)), starts[1:]):
            _enter(whole, part.columns.at(scan), part.views, T_whole_snapshot, first)
    whole.keyframes.extend(item.moved(T_whole_snapshot) for item in snapshot.keyframes)


def _whole_scans(seen_by: Int32Array) -> Iterator[IntArray]:
    """Yield the rows (N,) sorted by scan, in pieces that no scan is cut by."""
    order = np.argsort(seen_by, kind="stable")
    starts = np.flatnonzero(np.diff(seen_by[order], prepend=-1))
    ends = np.append(starts[1:], len(order))
    begin = 0
    for end in ends.tolist():
        if end - begin >= _CHUNK_ROWS or begin < end == len(order):
            yield order[begin:end]
            begin = end


def _enter(whole: PointMap, scan: Columns, views: FloatArray, T_whole_snapshot: FloatArray, first: int) -> None:
    """Enter the points that one scan saw; scans are numbered from ``first`` on."""
    number = int(scan.seen_by[0])
    T_snapshot_camera = np.concatenate([views[number], [[0.0, 0.0, 0.0, 1.0]]])
    target = whole.insert(
        Stripe(
            stamp_ns=int(scan.entered_ns.min()),
            number=first + number,
            T_map_camera=T_whole_snapshot @ T_snapshot_camera,
            points=transform(T_whole_snapshot, scan.position),
            normals=(scan.normal @ T_whole_snapshot[:3, :3].T).astype(np.float32),
            planarity=scan.planarity,
            colours=scan.colour,
            sigma=scan.sigma.astype(np.float64),
            solid=scan.solid,
        )
    )
    whole.add_weight(target, scan.weight - 1)
    whole.add_albedo(target, scan)


def relit(snapshot: Snapshot, light: Light | None) -> Snapshot:
    """Return a map whose colours, with ``light`` taken out, are what they were with its own light taken out."""
    if light is None or snapshot.light is None or not len(snapshot):
        return snapshot
    own = restore(snapshot)
    every = own.alive()
    shown = own.shown_colours(every, snapshot.light, as_seen=False)
    under_other = own.shown_colours(every, light, as_seen=False)
    with np.errstate(invalid="ignore", divide="ignore"):
        gain = np.where(under_other > 0, shown / under_other, np.where(np.isnan(under_other), np.nan, 1.0))
    colour = (snapshot.columns.colour * gain).astype(np.float32)
    return replace(snapshot, columns=replace(snapshot.columns, colour=colour), light=light)


def surface_of_map(snapshot: Snapshot) -> Surface:
    """Return the surface of a map, thinned piece by piece before anything is made of it."""
    columns, kept = snapshot.columns, [np.empty(0, np.int64)]
    for start in range(0, len(snapshot), _CHUNK_ROWS):
        piece = columns.at(slice(start, start + _CHUNK_ROWS))
        flat = np.flatnonzero(piece.normal.any(axis=1))
        kept.append(start + flat[thin_to_voxel(piece.position[flat], piece.weight[flat], ICP_VOXEL_M)])
    c = columns.at(np.concatenate(kept))
    own = restore(replace(snapshot, columns=c, keyframes=()))
    colours = own.shown_colours(own.alive(), snapshot.light, as_seen=False)
    return surface_of(c.position, c.normal, colours, c.weight, ICP_VOXEL_M)
