from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vli_mapping.spatial_hash import NONE, SpatialHash, any_near, bucket_of, link_one, neighbours, unlink_one


def near(grid: SpatialHash, points: np.ndarray, centre: np.ndarray, radius: float) -> set[int]:
    found = np.empty(len(points) + 1, np.int64)
    count = neighbours(grid.heads, grid.next, points, centre, radius, grid.cell_m, found)
    assert len(set(found[:count].tolist())) == count, "a point was reported twice"
    return set(found[:count].tolist())


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 1000), radius=st.floats(1e-4, 2e-3), cell=st.floats(2e-4, 2e-3))
def test_the_neighbours_are_those_of_a_search_through_all(seed: int, radius: float, cell: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3e-3, 3e-3, (300, 3))
    grid = SpatialHash.of(points, cell)
    for centre in rng.uniform(-3e-3, 3e-3, (10, 3)):
        distance = np.linalg.norm(points - centre, axis=1)
        assert near(grid, points, centre, radius) == set(np.flatnonzero(distance <= radius).tolist())
        assert any_near(grid.heads, grid.next, points, centre, radius, cell) == bool((distance <= radius).any())


def test_a_crowded_table_mixes_no_cells_up() -> None:
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (20000, 3))
    grid = SpatialHash(0.05, 8)
    grid.next = np.empty(len(points), np.int32)
    for index, point in enumerate(points):
        link_one(grid.heads, grid.next, index, point, grid.cell_m)
    distance = np.linalg.norm(points, axis=1)
    assert near(grid, points, np.zeros(3), 0.2) == set(np.flatnonzero(distance <= 0.2).tolist())


def test_no_more_is_written_than_there_is_room_for() -> None:
    points = np.zeros((10, 3))
    grid = SpatialHash.of(points, 1e-3)
    found = np.full(4, NONE, np.int64)
    assert neighbours(grid.heads, grid.next, points, np.zeros(3), 1e-4, grid.cell_m, found) == 4


def test_a_point_taken_out_is_not_found_and_the_rest_of_its_chain_is() -> None:
    points = np.zeros((5, 3))
    for removed in range(5):
        grid = SpatialHash.of(points, 1e-3)
        unlink_one(grid.heads, grid.next, removed, points[removed], grid.cell_m)
        assert near(grid, points, np.zeros(3), 1e-4) == set(range(5)) - {removed}


def test_points_are_found_again_after_the_table_has_grown_but_for_those_that_were_out_of_it() -> None:
    points = np.random.default_rng(2).uniform(0, 1e-2, (3000, 3))
    grid = SpatialHash.of(points, 1e-3)
    linked = np.ones(3000, np.bool_)
    linked[7] = False
    buckets = len(grid.heads)
    unlink_one(grid.heads, grid.next, 7, points[7], grid.cell_m)
    grid.reserve(20000, points, linked)
    assert len(grid.heads) > buckets
    assert near(grid, points, points[7], 2e-2) == set(range(3000)) - {7}


@pytest.mark.parametrize("cell", [(0, 0, 0), (-1, -1, -1), (-5, 1000, 3), (2**30, -(2**30), 7)])
def test_every_cell_has_a_bucket_and_neighbours_in_a_block_are_beside_each_other(cell: tuple[int, int, int]) -> None:
    i, j, k = (np.int64(value) for value in cell)
    first = bucket_of(i & ~np.int64(3), j & ~np.int64(3), k & ~np.int64(3), 1 << 16)
    assert 0 <= bucket_of(i, j, k, 1 << 16) < 1 << 16
    assert bucket_of(i, j, k, 1 << 16) // 64 == first // 64
