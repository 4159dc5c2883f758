"""A copy of the map, taken in small steps so that scans go on entering meanwhile, and a map made of such a copy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import numpy as np

from vli_common.arrays import AnyArray, FloatArray
from vli_mapping.allocation import Allocate, in_memory
from vli_mapping.config import MapConfig
from vli_mapping.keyframe import MapKeyframe
from vli_mapping.light import Light
from vli_mapping.point_map import Columns, PointMap

Exclusively = Callable[[Callable[[], Any]], Any]
"""Runs one step, and returns its result, where nothing changes the map meanwhile."""
CHUNK_ROWS = 1 << 14
"""Rows copied in one step: some 1.5 MB, a millisecond."""


@dataclass(frozen=True)
class Snapshot:
    """All that a map is, without a free row; what was copied later may be newer, each row is whole.

    Args:
        columns: of N points.
        views: (S, 3, 4), of the scans that ``columns.seen_by`` numbers.
        light: on board, None where it is not known.
        origin: names the frame of the map among those of other sessions and back ends; empty where nobody said.
        keyframes: views by which a scanner finds its way back.
    """

    columns: Columns
    views: FloatArray
    light: Light | None
    origin: str = ""
    keyframes: tuple[MapKeyframe, ...] = ()

    def __len__(self) -> int:
        return len(self.columns.weight)


def take(point_map: PointMap, light: Light | None, exclusively: Exclusively = lambda step: step()) -> Snapshot:
    """Return a copy of a map.

    Args:
        point_map: may change between two steps.
        light: of the same scan.
        exclusively: see :data:`Exclusively`; called once for every ``CHUNK_ROWS`` rows.
    """
    chunks: list[Columns] = []
    start = 0
    while start < exclusively(lambda: point_map.rows):
        chunks.append(exclusively(partial(_copy, point_map, start)))
        start += CHUNK_ROWS
    views: FloatArray = exclusively(point_map.views.copy)
    keyframes: tuple[MapKeyframe, ...] = exclusively(lambda: tuple(point_map.keyframes))
    return Snapshot(_joined(chunks), views, light, keyframes=keyframes)


def view(point_map: PointMap, light: Light | None) -> Snapshot:
    """Return a map as it is, without a copy of its points where none has left; for who owns it alone and changes it no more."""
    if len(point_map) < point_map.rows:
        return take(point_map, light)
    return Snapshot(point_map.columns.at(slice(point_map.rows)), point_map.views, light, keyframes=tuple(point_map.keyframes))


def restore(snapshot: Snapshot, config: MapConfig | None = None, allocate: Allocate = in_memory) -> PointMap:
    """Return a map that holds what a snapshot does, in arrays of its own from ``allocate``."""
    result = PointMap(config, max(len(snapshot), 1 << 16), allocate)
    result.fill(snapshot.columns, snapshot.views)
    result.keyframes.extend(snapshot.keyframes)
    return result


def _copy(point_map: PointMap, first: int) -> Columns:
    """Return the points among ``CHUNK_ROWS`` rows."""
    columns = point_map.columns
    rows = slice(first, min(first + CHUNK_ROWS, point_map.rows))
    alive = columns.weight[rows] > 0
    return Columns(*(getattr(columns, item.name)[rows][alive] for item in fields(columns)))


def _joined(chunks: list[Columns]) -> Columns:
    def column(name: str) -> AnyArray:
        return np.concatenate([getattr(Columns.empty(0), name), *(getattr(chunk, name) for chunk in chunks)])

    return Columns(*(column(item.name) for item in fields(Columns)))
