from __future__ import annotations

import numpy as np
import pytest
from mapping_scenes import looking_down, sheet, stripe

from vli_mapping.config import MapConfig
from vli_mapping.point_map import PointMap, to_bytes
from vli_mapping.thinning import thin

UP, SIDE = np.array([[0, 0, 1]], np.float32), np.array([[1, 0, 0]], np.float32)


def two(first: dict[str, object], second: dict[str, object], distance: float = 5e-5) -> PointMap:
    """Return a map of two points, so far apart along x."""
    point_map = PointMap(capacity=4)
    point_map.insert(stripe(np.zeros((1, 3)), 0, **first))
    point_map.insert(stripe(np.array([[distance, 0, 0]]), 1, **second))
    return point_map


def test_near_points_become_one_and_far_points_do_not() -> None:
    radius = MapConfig().merge_radius
    assert len(two({}, {}, 0.9 * radius)) == 1
    assert len(two({}, {}, 1.1 * radius)) == 2


def test_positions_are_averaged_by_their_sigmas() -> None:
    point_map = two({"sigma": np.array([1e-5])}, {"sigma": np.array([2e-5])}, 5e-5)
    assert point_map.cloud().points[0, 0] == pytest.approx(5e-5 * (1 / 4) / (1 + 1 / 4), rel=1e-5)
    assert point_map.columns.sigma[0] == pytest.approx(1 / np.hypot(1e5, 5e4), rel=1e-5)
    assert point_map.cloud().weights == pytest.approx([2.0])


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({"normals": UP}, {"normals": SIDE}),
        ({"normals": UP}, {"normals": -UP}),
        ({"colours": np.zeros((1, 3), np.float32)}, {"colours": np.array([[0, 0, 200]], np.float32)}),
    ],
)
def test_points_of_another_normal_or_colour_do_not_merge(first: dict[str, object], second: dict[str, object]) -> None:
    assert len(two(first, second)) == 2


def test_an_unknown_normal_or_colour_agrees_with_any_and_is_learnt() -> None:
    unknown = np.full((1, 3), np.nan, np.float32)
    point_map = two({"colours": unknown}, {"normals": SIDE, "colours": np.array([[1, 2, 3]], np.float32)})
    cloud = point_map.cloud()
    assert len(cloud) == 1
    np.testing.assert_array_equal(cloud.normals, SIDE)
    np.testing.assert_array_equal(cloud.colours, [[1, 2, 3]])


def test_colours_are_averaged_and_an_unseen_point_is_mid_grey() -> None:
    point_map = two({"colours": np.array([[100, 100, 100]], np.float32)}, {"colours": np.array([[110, 90, 100]], np.float32)})
    np.testing.assert_array_equal(point_map.cloud().colours, [[105, 95, 100]])
    np.testing.assert_array_equal(to_bytes(np.full((1, 3), np.nan, np.float32)), [[128, 128, 128]])


def test_the_weight_is_capped_so_that_an_old_point_goes_on_following() -> None:
    point_map = PointMap(MapConfig(max_weight=5.0))
    for number in range(100):
        point_map.insert(stripe(np.zeros((1, 3)), number))
    assert point_map.cloud().weights == pytest.approx([5.0])
    for number in range(30):
        point_map.insert(stripe(np.array([[1e-4, 0, 0]]), number))
    assert point_map.cloud().points[0, 0] == pytest.approx(1e-4, rel=0.02)


def test_a_point_that_moves_into_another_cell_is_still_found() -> None:
    point_map = PointMap(MapConfig(max_weight=1.0))
    for number in range(200):
        point_map.insert(stripe(np.array([[number * 2e-5, 0, 0]]), number))
    assert len(point_map) == 1
    assert point_map.cloud().points[0, 0] == pytest.approx(199 * 2e-5, abs=5e-5)


def test_a_map_that_grows_keeps_and_finds_what_it_had() -> None:
    point_map = PointMap(capacity=2)
    sheet(point_map, rows=60)
    before = point_map.cloud()
    sheet(point_map, rows=60, first_number=60)
    after = point_map.cloud()
    assert len(before) == len(after) == 3600
    np.testing.assert_allclose(after.points, before.points, atol=1e-9)
    assert set(after.weights.tolist()) == {2.0}


def test_doubtful_points_stay_only_where_nothing_solid_is_near() -> None:
    point_map = PointMap()
    sheet(point_map, rows=5)
    over, beside = np.array([[3e-4, 3e-4, 3e-4]]), np.array([[3e-3, 0, 0]])
    doubtful = np.zeros(1, np.bool_)
    assert point_map.insert(stripe(over, 9, solid=doubtful)).tolist() == [-1]
    assert point_map.insert(stripe(beside, 9, solid=doubtful)).tolist() == [25]
    assert len(point_map) == 26


def test_doubtful_points_leave_when_a_solid_one_comes_and_their_rows_are_used_again() -> None:
    point_map = PointMap()
    first = point_map.insert(stripe(np.array([[0, 0, 3e-4]]), 0, solid=np.zeros(1, np.bool_)))
    second = point_map.insert(stripe(np.zeros((1, 3)), 1))
    assert len(point_map) == 1
    assert first.tolist() == second.tolist() == [0]
    np.testing.assert_array_equal(point_map.cloud().points, np.zeros((1, 3)))
    point_map.insert(stripe(np.array([[1e-3, 0, 0]]), 2))
    assert (len(point_map), point_map.rows) == (2, 2)


def test_rows_of_points_that_left_are_not_alive_and_survive_growth() -> None:
    point_map = PointMap(capacity=4)
    far = np.array([[5e-3, 0, 0], [6e-3, 0, 0]])
    point_map.insert(stripe(far, 0, solid=np.zeros(2, np.bool_)))
    point_map.insert(stripe(np.array([[5e-3, 0, 1e-4], [5e-3, 1e-3, 0]]), 1))
    sheet(point_map, rows=10, first_number=2)
    assert point_map.rows == len(point_map) == 103
    point_map.insert(stripe(np.array([[6e-3, 0, 1e-4]]), 50))
    assert len(point_map) == 103
    assert len(point_map.cloud()) == len(point_map.alive())


def test_solid_points_of_a_stripe_enter_before_its_doubtful_ones() -> None:
    point_map = PointMap()
    points = np.array([[0, 0, 3e-4], [0, 0, 0]])
    assert point_map.insert(stripe(points, 0, solid=np.array([False, True]))).tolist() == [-1, 0]


def test_normals_are_fitted_again_to_what_has_come_and_face_the_sensor() -> None:
    point_map = PointMap()
    sheet(point_map, rows=12)
    assert not point_map.cloud().normals.any()
    point_map.refine_normals(point_map.alive(), np.array([0, 0, -1.0]))
    np.testing.assert_allclose(point_map.cloud().normals, np.broadcast_to([0, 0, -1], (144, 3)), atol=1e-5)
    # A normal that is known keeps its side wherever it is seen from later.
    point_map.refine_normals(point_map.alive(), np.array([0, 0, 1.0]))
    assert (point_map.cloud().normals[:, 2] < -0.99).all()


def test_merging_averages_noise_down() -> None:
    point_map = PointMap()
    rng = np.random.default_rng(0)
    x = np.arange(100) * 4e-4
    for number in range(16):
        points = np.stack([x, np.zeros(100), rng.normal(size=100) * 3e-5], axis=1)
        point_map.insert(stripe(points, number))
    assert len(point_map) == 100
    assert point_map.cloud().points[:, 2].std() == pytest.approx(3e-5 / 4, rel=0.25)


@pytest.mark.parametrize("limit", [50, 500, 2000])
def test_a_thinned_map_is_small_enough_not_much_smaller_and_all_over(limit: int) -> None:
    point_map = PointMap()
    sheet(point_map, rows=60)
    cloud = point_map.thinned(limit)
    assert 0.4 * limit <= len(cloud) <= limit
    assert np.ptp(cloud.points[:, 0]) > 0.8 * 60 * 3e-4
    assert point_map.thinned(10_000).points.shape == (3600, 3)


def test_thinning_keeps_the_heaviest_of_a_voxel() -> None:
    points = np.array([[0, 0, 0], [1e-5, 0, 0], [2e-5, 0, 0], [1e-2, 0, 0]])
    assert thin(points, np.array([1, 7, 3, 1], np.float32), 2).tolist() == [1, 3]


def test_the_same_stripes_give_the_same_map() -> None:
    clouds = []
    for _ in range(2):
        point_map = PointMap()
        rng = np.random.default_rng(5)
        for number in range(20):
            point_map.insert(stripe(rng.uniform(0, 3e-3, (200, 3)), number, solid=rng.random(200) > 0.3))
        clouds.append(point_map.cloud())
    assert clouds[0].points.tobytes() == clouds[1].points.tobytes()
    assert clouds[0].colours.tobytes() == clouds[1].colours.tobytes()


@pytest.mark.parametrize(("height", "expected"), [(0.012, 200), (0.03, 100), (0.05, 100)])
def test_of_two_visits_the_colour_of_the_one_with_clearly_more_light_stays(height: float, expected: int) -> None:
    point_map = PointMap(MapConfig(merge_colour=255.0))
    for number, value, z in ((0, 100, 0.03), (500, 200, height)):
        colours = np.full((1, 3), value, np.float32)
        point_map.insert(stripe(np.zeros((1, 3)), number, colours=colours, normals=UP, T_map_camera=looking_down(0.0, 0.0, z)))
    np.testing.assert_array_equal(point_map.cloud().colours, [[expected] * 3])
    assert point_map.columns.seen_by[0] == (500 if expected == 200 else 0)
