from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from mapping_scenes import looking_down, stripe

from vli_common.arrays import FloatArray, IntArray
from vli_mapping.config import MapConfig
from vli_mapping.contradiction import contradict
from vli_mapping.point_map import PointMap, Stripe
from vli_mapping.snapshot import restore, take

SPACING, STEP = 1.6e-4, 3e-4
"""Points of a stripe are farther apart than points that merge; stripes."""
HEIGHT = 3e-3
WIDTH = 30


def patch(y: float, z: float = 0.0, first: float = 0.0, count: int = WIDTH) -> FloatArray:
    """Return ``count`` points (N, 3) along x at height z."""
    x = first + SPACING * np.arange(count)
    return np.stack([x, np.full(count, y), np.full(count, z)], axis=1)


def scan(point_map: PointMap, rows: int, z: float = 0.0, first_number: int = 0, y: float = 0.0, count: int = WIDTH) -> IntArray:
    """Insert a patch of surface, one stripe a row; return the rows (K,) that its points have in the map."""
    return np.concatenate(
        [point_map.insert(stripe(patch(y + row * STEP, z, count=count), first_number + row)) for row in range(rows)]
    )


def speak_against(point_map: PointMap, which: IntArray, witness: int = 60) -> int:
    """Let a view contradict rows, which sees a surface of ``witness`` stripes there instead; return how many more left with them.

    That surface comes and goes, out of everyone's way.
    """
    first = len(point_map.views)
    surface = scan(point_map, witness, first_number=first, y=1.0)
    assert point_map.halve(which) == len(which)
    seen = np.tile(patch(1.0 + witness * STEP)[WIDTH // 2], (len(which), 1))
    left = point_map.remove_with(which, seen, first + witness)
    point_map.remove(surface)
    return left


def spread_over(rows: IntArray, share: float, seed: int = 0) -> IntArray:
    """Return some of the rows, ascending."""
    return np.sort(np.random.default_rng(seed).choice(rows, int(share * len(rows)), replace=False))


@pytest.mark.parametrize("share", [0.05, 0.1, 0.5])
def test_a_ghost_leaves_as_one_when_a_part_of_it_is_contradicted(share: float) -> None:
    point_map = PointMap()
    ghost = scan(point_map, 8)
    contradicted = spread_over(ghost, share)
    assert speak_against(point_map, contradicted) == len(ghost) - len(contradicted)
    assert len(point_map) == 0


def test_one_that_is_switched_off_loses_only_what_is_contradicted() -> None:
    point_map = PointMap(MapConfig(piece_share=1.0))
    ghost = scan(point_map, 8)
    assert speak_against(point_map, spread_over(ghost, 0.9)) == 0
    assert len(point_map) == len(ghost) - int(0.9 * len(ghost))


def test_a_surface_of_which_an_edge_is_contradicted_stays() -> None:
    point_map = PointMap()
    surface = scan(point_map, 40)
    assert speak_against(point_map, surface[: WIDTH // 2]) == 0
    assert len(point_map) == len(surface) - WIDTH // 2


def test_a_surface_that_a_ghost_contradicts_stays() -> None:
    point_map = PointMap()
    surface = scan(point_map, 8)
    assert speak_against(point_map, spread_over(surface, 0.3), witness=7) == 0
    assert speak_against(point_map, surface[point_map.columns.weight[surface] > 0][:1], witness=9) == 0
    assert len(point_map) == len(surface) - int(0.3 * len(surface)) - 1


def test_one_that_sees_what_nobody_saw_before_is_no_evidence() -> None:
    point_map = PointMap()
    ghost = scan(point_map, 8)
    contradicted = spread_over(ghost, 0.5)
    point_map.halve(contradicted)
    assert point_map.remove_with(contradicted, np.full((len(contradicted), 3), 1.0), 100) == 0


def test_two_points_are_no_evidence_however_small_the_piece() -> None:
    point_map = PointMap()
    tiny = scan(point_map, 2, count=4)
    assert speak_against(point_map, tiny[:2]) == 0
    assert speak_against(point_map, tiny[2:3]) == len(tiny) - 3


def test_a_surface_that_a_later_visit_has_confirmed_stays() -> None:
    point_map = PointMap()
    surface = scan(point_map, 8)
    assert scan(point_map, 8, first_number=100).tolist() == surface.tolist()
    assert speak_against(point_map, spread_over(surface, 0.3)) == 0


def test_scans_of_the_same_visit_confirm_nothing() -> None:
    """A reflection stands still for as long as the scanner does."""
    point_map = PointMap()
    ghost = scan(point_map, 8)
    assert scan(point_map, 8, first_number=7).tolist() == ghost.tolist()
    assert speak_against(point_map, spread_over(ghost, 0.3)) == len(ghost) - int(0.3 * len(ghost))


def test_what_is_beside_a_ghost_on_the_same_stripes_stays() -> None:
    point_map = PointMap()
    for number in range(8):
        y = number * STEP
        above = patch(y, HEIGHT, first=WIDTH * SPACING)
        point_map.insert(stripe(np.concatenate([patch(y), above, patch(y, first=2 * WIDTH * SPACING)]), number))
    is_ghost = point_map.columns.position[:, 2] > 0.5 * HEIGHT
    ghost = point_map.alive()[is_ghost[point_map.alive()]]
    assert len(ghost) == 8 * WIDTH
    assert speak_against(point_map, spread_over(ghost, 0.1)) == len(ghost) - int(0.1 * len(ghost))
    assert len(point_map) == 16 * WIDTH
    assert not is_ghost[point_map.alive()].any()


def test_what_a_later_stripe_joins_is_one_piece() -> None:
    point_map = PointMap()
    wide = 4 * WIDTH
    for number in range(4):
        ends = patch(number * STEP, count=wide)
        point_map.insert(stripe(np.concatenate([ends[:WIDTH], ends[-WIDTH:]]), number))
    parts = point_map.alive()
    point_map.insert(stripe(patch(4 * STEP, count=wide), 4))
    # Each part by itself has lost too few.
    whole = len(point_map)
    assert speak_against(point_map, parts[:2]) == 0
    assert speak_against(point_map, parts[-8:]) == whole - 10


def test_rows_that_are_used_again_belong_to_what_they_hold_now() -> None:
    point_map = PointMap()
    ghost = scan(point_map, 8, HEIGHT)
    rest = ghost[4 * WIDTH :]
    point_map.remove(ghost[: 4 * WIDTH])
    # In the place that the ghost has left.
    surface = scan(point_map, 4, HEIGHT, first_number=50)
    assert set(surface) == set(ghost[: 4 * WIDTH])
    assert speak_against(point_map, spread_over(rest, 0.2)) == len(rest) - int(0.2 * len(rest))
    assert set(point_map.alive()) == set(surface)


def test_what_left_makes_room_for_what_comes() -> None:
    point_map = PointMap()
    ghost = scan(point_map, 8)
    speak_against(point_map, spread_over(ghost, 0.1))
    rows = point_map.rows
    surface = scan(point_map, 8, first_number=100)
    assert len(set(surface)) == len(ghost)
    assert point_map.rows == rows
    # Every point is found again: it merges.
    assert scan(point_map, 8, first_number=200).tolist() == surface.tolist()


def test_a_map_that_was_loaded_neither_gives_evidence_nor_leaves_by_it() -> None:
    before = PointMap()
    old = scan(before, 8)
    speak_against(before, old[:2])
    point_map = restore(take(before, None))
    old = point_map.alive()
    new = scan(point_map, 8, first_number=8, y=8 * STEP)
    assert speak_against(point_map, spread_over(old, 0.5)) == 0
    assert speak_against(point_map, spread_over(new, 0.1)) == len(new) - int(0.1 * len(new))
    assert set(point_map.alive()) < set(old)


def test_a_map_that_grows_keeps_what_it_knows_of_pieces() -> None:
    point_map = PointMap(capacity=16)
    ghost = scan(point_map, 8)
    for number in range(2000):
        point_map.insert(stripe(np.array([[0.1 + 5e-3 * number, 0.0, 0.0]]), 100 + number))
    assert speak_against(point_map, spread_over(ghost, 0.1)) == len(ghost) - int(0.1 * len(ghost))
    assert len(point_map) == 2000


def noisy_row(rng: np.random.Generator, number: int) -> Stripe:
    """Return a stripe over a plane, a random stretch of which stands above it, seen from a camera that looks along."""
    y = number % 25 * STEP + rng.uniform(-1e-4, 1e-4)
    points = patch(y, count=60) + rng.normal(size=(60, 3)) * 2e-5
    if number % 9 < 4:
        points[20:35, 2] += HEIGHT
    return stripe(points, number, T_map_camera=looking_down(5e-3, y - 0.015))


def played(config: MapConfig) -> tuple[PointMap, int, int]:
    """Return a map that saw four passes with ghosts, how many points left singly, and how many with their piece."""
    point_map, rng, singly, with_piece = PointMap(config), np.random.default_rng(5), 0, 0
    for number in range(100):
        item, gone, more = contradict(point_map, noisy_row(rng, number))
        point_map.insert(item)
        singly, with_piece = singly + gone, with_piece + more
    return point_map, singly, with_piece


def above(point_map: PointMap) -> int:
    return int((point_map.columns.position[point_map.alive(), 2] > 0.5 * HEIGHT).sum())


def test_later_views_take_more_of_the_ghosts_and_no_more_of_the_surface() -> None:
    point_map, _, more = played(MapConfig())
    alone, _, none = played(MapConfig(piece_share=1.0))
    assert none == 0 < more
    assert above(point_map) < 0.7 * above(alone)
    assert len(point_map) - above(point_map) > 0.99 * (len(alone) - above(alone))


def test_the_same_stripes_make_the_same_map() -> None:
    one, other = played(MapConfig()), played(MapConfig())
    assert one[1:] == other[1:]
    rows = one[0].alive()
    assert rows.tolist() == other[0].alive().tolist()
    for item in fields(one[0].columns):
        np.testing.assert_array_equal(getattr(one[0].columns, item.name)[rows], getattr(other[0].columns, item.name)[rows])


def test_an_empty_stripe_changes_nothing() -> None:
    point_map = PointMap()
    scan(point_map, 2)
    before = len(point_map)
    whole = stripe(patch(0.0), 9)
    arrays = [item.name for item in fields(whole) if item.name != "T_map_camera" and np.ndim(getattr(whole, item.name))]
    item, *left = contradict(point_map, replace(whole, **{name: getattr(whole, name)[:0] for name in arrays}))
    assert point_map.insert(item).tolist() == []
    assert left == [0, 0]
    assert len(point_map) == before
