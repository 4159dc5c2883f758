"""The landmark table: observations, laser depths, and what leaves with a keyframe."""

from __future__ import annotations

import numpy as np

from vli_backend.landmarks import KEPT_OBSERVATIONS, LandmarkPoints, LandmarkTable
from vli_common.arrays import IntArray

RHO = 30.0


def _add(table: LandmarkTable, ids: list[int], restarted: list[int] | None = None) -> None:
    keys: IntArray = np.array(ids, np.int64)
    rays = np.stack([keys * 0.01, np.full(len(keys), table.frames * 0.1)], axis=1)
    table.forget_lost(keys)
    table.add_keyframe(keys, rays, np.tile(1e3 * np.eye(2), (len(keys), 1, 1)), np.isin(keys, restarted or []), RHO)


def test_a_feature_seen_twice_is_usable_and_anchored_at_the_first_sight() -> None:
    table = LandmarkTable(9)
    _add(table, [1, 2])
    _add(table, [2, 3])
    row = int(table.rows_of(np.array([2]))[0])
    assert table.usable[row]
    assert table.arrays.anchor[row] == 0
    np.testing.assert_allclose(table.arrays.anchor_ray[row], [0.02, 0.0])


def test_a_feature_lost_after_one_sight_is_forgotten() -> None:
    table = LandmarkTable(9)
    _add(table, [1, 2])
    _add(table, [2])
    assert 1 not in table.ids


def test_a_track_with_a_new_patch_becomes_a_new_landmark() -> None:
    table = LandmarkTable(9)
    for _ in range(3):
        _add(table, [5])
    _add(table, [5], restarted=[5])
    assert list(table.ids) == [5, 5]
    assert list(table.active) == [False, True]
    assert table.arrays.anchor[1] == 3


def test_guesses_can_be_made_to_say_less_and_what_was_adopted_stays() -> None:
    table = LandmarkTable(9, spread=0.5)
    _add(table, [1, 2])
    known = LandmarkPoints(np.array([2]), np.array([[0.0, 0.0, 0.04]]), np.array([[0.0, 0.0, 4e-4]]))
    table.adopt(known, np.eye(4), 0.01)
    table.widen(2.0)
    np.testing.assert_allclose(table.arrays.prior, [[RHO, 2.0 * RHO], [25.0, 0.25]])


def test_the_primary_frame_is_the_one_nearest_to_the_stripe() -> None:
    table = LandmarkTable(9)
    for _ in range(3):
        _add(table, [7])
    row = np.array([0])
    for slot, distance in ((0, 9.0), (1, 2.0), (2, 5.0)):
        table.set_depths(slot, row, np.array([RHO + slot]), np.array([0.1]), np.array([distance]), primary_only=True)
    assert list(np.flatnonzero(table.arrays.depth_sigma[0])) == [1]
    assert table.arrays.depth[0, 1] == RHO + 1


def test_a_remeasured_primary_frame_may_lose_to_itself_only() -> None:
    table = LandmarkTable(9)
    _add(table, [7])
    for distance in (2.0, 4.0):
        table.set_depths(0, np.array([0]), np.array([RHO + distance]), np.array([0.1]), np.array([distance]), primary_only=True)
    assert table.arrays.depth[0, 0] == RHO + 4.0


def test_all_frames_may_measure_where_asked() -> None:
    table = LandmarkTable(9)
    for _ in range(2):
        _add(table, [7])
    for slot in (0, 1):
        table.set_depths(slot, np.array([0]), np.array([RHO]), np.array([0.1]), np.array([1.0]), primary_only=False)
    assert np.count_nonzero(table.arrays.depth_sigma[0]) == 2


def test_a_split_counts_every_observation_once() -> None:
    table = LandmarkTable(9)
    for _ in range(9):
        _add(table, [1])
    before = int(np.count_nonzero(table.arrays.seen))
    leaving = table.split()
    assert list(leaving) == [True, False]
    assert int(np.count_nonzero(table.arrays.seen)) == before
    assert table.observations[1] == KEPT_OBSERVATIONS
    assert table.arrays.anchor[1] == 9 - KEPT_OBSERVATIONS


def test_a_landmark_whose_track_ended_leaves_whole() -> None:
    table = LandmarkTable(9)
    _add(table, [1, 2])
    for _ in range(7):
        _add(table, [2])
    _add(table, [2])
    assert list(table.split()) == [True, False]
    table = LandmarkTable(9)
    _add(table, [1, 2])
    _add(table, [1, 2])
    for _ in range(7):
        _add(table, [2])
    leaving = table.split()
    assert np.count_nonzero(leaving) == 2
    assert len(table) == 3


def test_dropping_the_oldest_moves_all_slots_down() -> None:
    table = LandmarkTable(4)
    for ids in ([1, 2], [1, 2, 3], [2, 3], [2, 3]):
        _add(table, ids)
    leaving = table.split()
    table.drop_oldest(leaving)
    assert table.frames == 3
    assert set(table.ids) == {2, 3}
    row = int(table.rows_of(np.array([3]))[0])
    assert table.arrays.anchor[row] == 0
    np.testing.assert_allclose(table.arrays.rays[row, :3, 1], [0.1, 0.2, 0.3])
    assert not table.arrays.seen[:, 3].any()
