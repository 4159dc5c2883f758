"""When the mapping stage says that the scene has changed."""

from __future__ import annotations

import numpy as np

from vli_mapping.scene_change import SceneChange

POINTS, SCANS = 480, 30
EVERY = np.ones(POINTS, np.bool_)


def watched(hidden, solid=EVERY, scans=SCANS):
    change = SceneChange()
    for _ in range(scans):
        change.add(solid, solid & hidden)
    return change


def some(share, first=0, last=POINTS):
    """Hide a share of the points of one piece, evenly."""
    hidden = np.zeros(POINTS, np.bool_)
    hidden[first:last] = np.diff(np.floor(share * np.arange(last - first + 1))) > 0
    return hidden


def test_a_piece_of_the_stripe_seen_through_a_surface_for_a_second_is_a_change() -> None:
    assert watched(some(0.5, 180, 240)).hint.startswith("the scene has changed: 50 % of a stretch of the stripe ")


def test_as_many_points_all_along_the_stripe_are_edges() -> None:
    assert watched(some(0.5 * 60 / POINTS)).hint == ""
    assert watched(some(0.2)).hint == ""


def test_an_edge_that_the_stripe_runs_along_for_a_few_scans_is_none() -> None:
    change = watched(some(0.0))
    for _ in range(SCANS // 6):
        change.add(EVERY, EVERY)
    assert change.hint == ""


def test_less_than_a_second_says_nothing() -> None:
    assert watched(EVERY, scans=SCANS - 1).hint == ""
    assert watched(EVERY).hint != ""


def test_a_stretch_of_hardly_any_points_says_nothing() -> None:
    solid = EVERY.copy()
    solid[180:240] = False
    solid[180:240:20] = True
    hidden = np.zeros(POINTS, np.bool_)
    hidden[180:240] = True
    assert watched(hidden, solid).hint == ""


def test_stripes_without_a_solid_point_do_not_count() -> None:
    change = watched(EVERY, scans=SCANS - 1)
    change.add(np.zeros(POINTS, np.bool_), np.zeros(POINTS, np.bool_))
    change.add(np.zeros(0, np.bool_), np.zeros(0, np.bool_))
    assert change.hint == ""


def test_another_map_is_another_scene() -> None:
    change = watched(EVERY)
    change.clear()
    assert change.hint == ""
    assert change.share == 0.0
