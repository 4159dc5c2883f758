from __future__ import annotations

import numpy as np
import pytest
from mapping_scenes import looking_down, sheet, stripe

from vli_common.arrays import FloatArray
from vli_mapping.config import MapConfig
from vli_mapping.contradiction import contradict
from vli_mapping.point_map import PointMap

SPACING = 1e-4
LEAN = 0.5
"""Tangent of the angle at which the camera sees the stripe: a baseline of 15 mm at 30 mm."""


def row(y: float, z: float = 0.0, first: float = 0.0, last: float = 3e-3) -> FloatArray:
    """Return points (N, 3) along x at height z."""
    x = np.arange(first, last, SPACING)
    return np.stack([x, np.full_like(x, y), np.full_like(x, z)], axis=1)


def see(point_map: PointMap, points: FloatArray, number: int, lean: float = LEAN) -> int:
    """Let a camera 30 mm above z = 0, beside the stripe, see points; return how many points left the map."""
    T = looking_down(1.5e-3, float(points[:, 1].mean()) - lean * 0.03)
    item, *left = contradict(point_map, stripe(points, number, T_map_camera=T))
    point_map.insert(item)
    return sum(left)


def passes(point_map: PointMap, count: int, height: float = 0.0, first_number: int = 100) -> int:
    """Scan the strip y = −2 … 9 mm ``count`` times, stripes 0.45 mm apart, each pass a little beside the others."""
    left = 0
    rng = np.random.default_rng(0)
    for number in range(count):
        for step, y in enumerate(np.arange(-2e-3, 9e-3, 4.5e-4)):
            left += see(point_map, row(y + rng.uniform(0, 4.5e-4), height, -1e-3, 4e-3), first_number + 100 * number + step)
    return left


def floating(point_map: PointMap) -> int:
    return int((point_map.cloud().points[:, 2] > 5e-4).sum())


@pytest.mark.parametrize("height", [1e-3, 3e-3, 8e-3])
def test_a_ghost_above_the_surface_leaves_while_the_surface_is_seen_through_it(height: float) -> None:
    point_map = PointMap()
    see(point_map, row(1.5e-3, height), 0)
    ghosts = floating(point_map)
    assert ghosts > 10
    left = passes(point_map, 1)
    assert left > 0.2 * ghosts
    left += passes(point_map, 5, first_number=1000)
    assert floating(point_map) <= 0.1 * ghosts
    assert left >= 0.9 * ghosts


def test_without_a_radius_nothing_is_contradicted() -> None:
    point_map = PointMap(MapConfig(ray_radius=0.0))
    see(point_map, row(1.5e-3, 3e-3), 0)
    ghosts = floating(point_map)
    assert passes(point_map, 3) == 0
    assert floating(point_map) == ghosts


def test_a_surface_that_is_seen_again_loses_nothing() -> None:
    point_map = PointMap()
    rng = np.random.default_rng(1)
    for number in range(4):
        for y in np.arange(0, 3e-3, 1.5e-4):
            points = row(y)
            points[:, 2] += rng.normal(size=len(points)) * 3e-5
            assert see(point_map, points, number) == 0


def test_points_within_the_margin_of_what_is_seen_stay() -> None:
    point_map = PointMap()
    margin = MapConfig().ray_margin
    see(point_map, row(1.5e-3, 0.8 * margin), 0)
    before = len(point_map)
    assert passes(point_map, 4) == 0
    assert len(point_map) >= before


def test_a_ghost_below_the_surface_leaves_once_the_surface_hides_it() -> None:
    point_map = PointMap()
    ghosts = row(1.5e-3, -2e-3)
    see(point_map, ghosts, 0)
    before = int((point_map.cloud().points[:, 2] < -1e-3).sum())
    passes(point_map, 6)
    assert int((point_map.cloud().points[:, 2] < -1e-3).sum()) <= 0.2 * before


def test_a_point_behind_another_stays_where_it_was_seen_from_the_side() -> None:
    """The floor under a shelf: hidden from above, seen from beside it."""
    point_map = PointMap()
    for number, y in enumerate(np.arange(0, 3e-3, 2e-4)):
        points = row(y, -4e-3)
        T = looking_down(1.5e-3, y - 0.04, 0.01)
        point_map.insert(stripe(points, number, T_map_camera=T))
    floor = len(point_map)
    passes(point_map, 6, height=4e-3, first_number=1000)
    assert int((point_map.cloud().points[:, 2] < -3e-3).sum()) >= 0.95 * floor


def test_a_stripe_point_that_the_map_would_hide_is_doubted_and_a_ghost_below_does_not_carve_the_surface() -> None:
    point_map = PointMap()
    for number in range(4):
        sheet(point_map, rows=40, spacing=1.2e-4, first_number=100 * number)
    before = len(point_map)
    points = row(2.4e-3, -3e-3, 1e-3, 3e-3)
    T = looking_down(2e-3, 2.4e-3)
    item, left, with_piece = contradict(point_map, stripe(points, 900, T_map_camera=T))
    # A ray sees what lies in the cells that it crosses: some of its neighbours see more.
    assert item.solid.mean() <= 0.3
    assert left == with_piece == 0
    assert len(point_map) == before


def test_rays_along_a_wall_do_not_speak_against_it() -> None:
    """The flank of a key beside the ray: the floor at its foot is seen past it."""
    point_map = PointMap()
    x = np.arange(0, 3e-3, SPACING)
    for number, z in enumerate(np.arange(0, 6e-3, SPACING)):
        points = np.stack([x, np.zeros_like(x), np.full_like(x, z)], axis=1)
        normals = np.tile(np.array([0, -1, 0], np.float32), (len(x), 1))
        point_map.insert(stripe(points, number, normals=normals))
    before = len(point_map)
    for number in range(10):
        see(point_map, row(-1e-4), 100 + number, lean=0.0)
    assert len(point_map) >= before
