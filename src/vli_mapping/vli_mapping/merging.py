"""Several saved maps as one: each is aligned to what the others make up so far, and its points enter like those of a scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.geometry import transform
from vli_mapping.config import MapConfig
from vli_mapping.light import Light
from vli_mapping.point_map import PointMap, Stripe
from vli_mapping.registration import ICP_VOXEL_M, Registration, Surface, register, surface_of
from vli_mapping.snapshot import Snapshot, restore, take


def merge_maps(maps: Sequence[Snapshot], config: MapConfig | None = None) -> tuple[Snapshot, list[Registration]]:
    """Return one map in the frame of the first, and how each of the others lay in it.

    Args:
        maps: at least one; each shares a part with those before it.
        config: of the map that results.

    Raises:
        InputError: a map shares too little with those before it, or fits in more than one way.
    """
    whole, light = restore(maps[0], config), maps[0].light
    registrations = []
    for snapshot in maps[1:]:
        found = register(_surface(take(whole, light)), _surface(snapshot))
        join(whole, relit(snapshot, light), found.T_target_source)
        registrations.append(found)
    return take(whole, light), registrations


def join(whole: PointMap, snapshot: Snapshot, T_whole_snapshot: FloatArray) -> None:
    """Enter the points of a map into another, scan by scan as they were seen, with their weights."""
    c, first = snapshot.columns, len(whole.views)
    order = np.argsort(c.seen_by, kind="stable")
    starts = np.flatnonzero(np.diff(c.seen_by[order], prepend=-1))
    for rows in np.split(order, starts[1:]) if len(order) else []:
        number = int(c.seen_by[rows[0]])
        T_snapshot_camera = np.concatenate([snapshot.views[number], [[0.0, 0.0, 0.0, 1.0]]])
        target = whole.insert(
            Stripe(
                stamp_ns=int(c.entered_ns[rows].min()),
                number=first + number,
                T_map_camera=T_whole_snapshot @ T_snapshot_camera,
                points=transform(T_whole_snapshot, c.position[rows]),
                normals=(c.normal[rows] @ T_whole_snapshot[:3, :3].T).astype(np.float32),
                planarity=c.planarity[rows],
                colours=c.colour[rows],
                sigma=c.sigma[rows].astype(np.float64),
                solid=c.solid[rows],
            )
        )
        whole.add_weight(target, c.weight[rows] - 1)
    whole.keyframes.extend(item.moved(T_whole_snapshot) for item in snapshot.keyframes)


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


def _surface(snapshot: Snapshot) -> Surface:
    c = snapshot.columns
    own = restore(snapshot)
    colours = own.shown_colours(own.alive(), snapshot.light, as_seen=False)
    return surface_of(c.position, c.normal, colours, c.weight, ICP_VOXEL_M)
