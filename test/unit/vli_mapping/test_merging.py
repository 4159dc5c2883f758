"""Maps of one surface, in frames of their own, as one."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from vli_common.arrays import FloatArray
from vli_common.errors import InputError
from vli_common.geometry import inverse, pose, so3_exp, transform
from vli_mapping import merging
from vli_mapping.allocation import on_disk
from vli_mapping.light import Light
from vli_mapping.merging import merge_maps, relit
from vli_mapping.point_map import PointMap, Stripe
from vli_mapping.registration import Surface, likeness, refine
from vli_mapping.snapshot import Snapshot, restore, take

MOVED = pose(so3_exp(np.array([0.004, -0.006, 0.8])), np.array([0.03, -0.05, 0.002]))
HERE = np.eye(4)
NOISE_M = 2e-5


def relief(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return z (N,) of a surface on which no two places are alike."""
    rng = np.random.default_rng(7)
    z = np.zeros_like(x)
    for cx, cy, height, width in rng.uniform([-0.03, -0.015, -2e-3, 2e-3], [0.06, 0.015, 3e-3, 5e-3], (40, 4)):
        z += height * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * width**2))
    return z


def flat(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.zeros_like(x)


def keys(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return z (N,) of a surface that repeats every 12 mm along x."""
    return 2e-3 * np.exp(-(((np.mod(x, 0.012) - 0.006) ** 2 + y**2) / (2 * 0.003**2)))


def scan(x0: float, x1: float, T_map_world: FloatArray = HERE, surface=relief, seed: int = 0) -> Snapshot:
    """Return the map of the surface between x0 and x1, in a frame of its own."""
    rng = np.random.default_rng(seed)
    point_map = PointMap()
    y = np.arange(-0.012, 0.012, 2.5e-4)
    for number, x in enumerate(np.arange(x0, x1, 4e-4)):
        points = np.stack([np.full_like(y, x), y, surface(np.full_like(y, x), y) + rng.normal(size=len(y)) * NOISE_M], axis=1)
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[:3, 3] = x, 0.0, 0.03
        zeros, grey = np.zeros((len(y), 3), np.float32), np.full((len(y), 3), 100, np.float32)
        nothing, sigma = np.zeros(len(y), np.float32), np.full(len(y), NOISE_M)
        placed = transform(T_map_world, points)
        stripe = Stripe(number, number, T_map_world @ T, placed, zeros, nothing, grey, sigma, np.ones(len(y), np.bool_))
        point_map.insert(stripe)
    point_map.refine_normals(point_map.alive(), transform(T_map_world, np.array([[x0, 0.0, 0.05]]))[0])
    return take(point_map, None)


def test_a_merge_on_the_disk_is_that_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(merging, "_CHUNK_ROWS", 1000)
    maps = [scan(-0.01, 0.015), scan(0.0, 0.03, MOVED, seed=1)]
    (here, _), (there, _) = merge_maps(maps), merge_maps(iter(maps), allocate=on_disk(tmp_path))
    for item in fields(here.columns):
        np.testing.assert_array_equal(getattr(here.columns, item.name), getattr(there.columns, item.name))


def test_pieces_of_a_map_cut_no_scan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(merging, "_CHUNK_ROWS", 5)
    seen_by = np.array([3, 0, 0, 7, 3, 0, 7, 7, 7, 9], np.int32)
    pieces = [seen_by[rows].tolist() for rows in merging._whole_scans(seen_by)]
    assert pieces == [[0, 0, 0, 3, 3], [7, 7, 7, 7, 9]]
    assert list(merging._whole_scans(seen_by[:0])) == []


def test_two_maps_that_overlap_become_one_in_the_frame_of_the_first() -> None:
    left, right = scan(-0.03, 0.012), scan(-0.008, 0.035, MOVED, seed=1)
    merged, (found,) = merge_maps([left, right])
    error = found.T_target_source @ MOVED
    assert np.linalg.norm(transform(error, np.array([[0.015, 0.0, 0.0]])) - [[0.015, 0, 0]]) < 3e-5
    assert found.agreeing > 0.9
    position = merged.columns.position
    assert np.sqrt(((position[:, 2] - relief(position[:, 0], position[:, 1])) ** 2).mean()) < 3e-5
    assert position[:, 0].max() - position[:, 0].min() == pytest.approx(0.065, abs=1e-3)
    assert len(merged) < len(left) + len(right)
    assert merged.columns.weight.sum() <= left.columns.weight.sum() + right.columns.weight.sum()
    assert np.isfinite(restore(merged).cloud().points).all()


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_points_that_no_image_coloured_are_merged_by_their_shape(share: float) -> None:
    left, right = scan(-0.02, 0.012), scan(-0.008, 0.025, MOVED, seed=1)
    colour = right.columns.colour.copy()
    colour[np.random.default_rng(2).random(len(colour)) < share] = np.nan
    merged, (found,) = merge_maps([left, replace(right, columns=replace(right.columns, colour=colour))])
    assert found.agreeing > 0.9
    assert np.linalg.norm(transform(found.T_target_source @ MOVED, np.array([[0.0, 0.0, 0.0]]))) < 3e-5
    assert np.isfinite(merged.columns.colour).any()


def test_the_same_maps_give_the_same_result() -> None:
    maps = [scan(-0.03, 0.01), scan(-0.01, 0.03, MOVED, seed=1)]
    one, two = merge_maps(maps)[0], merge_maps(maps)[0]
    np.testing.assert_array_equal(one.columns.position, two.columns.position)


def test_maps_that_share_nothing_are_refused() -> None:
    other = scan(0.03, 0.06, MOVED, lambda x, y: relief(y, x + 1.0) + 5e-4 * np.sin(3e3 * y))
    with pytest.raises(InputError, match=r"share only|in two ways"):
        merge_maps([scan(-0.03, -0.01), other])


def test_maps_that_fit_in_two_ways_are_refused() -> None:
    with pytest.raises(InputError, match="in two ways"):
        merge_maps([scan(-0.03, 0.03, surface=keys), scan(-0.006, 0.018, MOVED, surface=keys, seed=1)])


def printed(snapshot: Snapshot, T_map_world: FloatArray = HERE, seed: int = 0, gain: float = 1.0) -> Snapshot:
    """Return a map whose surface has a print of blots some 1.5 mm wide, no two places of which are alike."""
    rng = np.random.default_rng(seed)
    angle, phase = rng.uniform(0, 2 * np.pi, (2, 12, 1))
    waves = 2 * np.pi / 3e-3 * np.stack([np.cos(angle[:, 0]), np.sin(angle[:, 0])], axis=1)
    world = transform(inverse(T_map_world), snapshot.columns.position)[:, :2]
    grey = gain * np.where(np.cos(waves @ world.T + phase).sum(axis=0) > 0, 150.0, 70.0)
    colour = np.repeat(grey[:, None], 3, axis=1).astype(np.float32)
    return replace(snapshot, columns=replace(snapshot.columns, colour=colour))


@pytest.mark.parametrize("gain", [1.0, 0.5])
def test_keys_that_repeat_are_told_apart_by_what_is_printed_on_them_however_bright(gain: float) -> None:
    whole = printed(scan(-0.03, 0.03, surface=keys))
    part = printed(scan(-0.006, 0.018, MOVED, surface=keys, seed=1), MOVED, gain=gain)
    _, (found,) = merge_maps([whole, part])
    assert np.linalg.norm(transform(found.T_target_source @ MOVED, np.zeros((1, 3)))) < 1e-4
    assert found.likeness > 0.6


def test_another_keyboard_with_the_same_keys_is_refused() -> None:
    whole = printed(scan(-0.03, 0.03, surface=keys))
    other = printed(scan(-0.006, 0.018, MOVED, surface=keys, seed=1), MOVED, seed=5)
    with pytest.raises(InputError, match=r"^map '2' does not join .*look alike to '[-0-9.]+' .*, expected '0\.43'"):
        merge_maps([whole, other])


def test_colours_that_vary_less_than_their_noise_tell_nothing() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 0.02, (3000, 3))
    faint = (100 + 6 * rng.normal(size=(2, 3000, 1)) * np.ones(3)).astype(np.float32)
    assert np.isnan(likeness(points, *faint))
    marked = (100 + 30 * rng.choice([-1, 1], (2, 3000, 1)) * np.ones(3)).astype(np.float32)
    assert abs(likeness(points, *marked)) < 0.1
    assert likeness(points, marked[0], marked[0] + faint[0] - 100) > 0.9
    unknown = np.full((3000, 3), np.nan, np.float32)
    assert np.isnan(likeness(points, marked[0], unknown))


def test_a_gradient_over_the_whole_overlap_is_no_likeness() -> None:
    """Two faces that fall off into the dark look alike at large, and nowhere close by."""
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 0.04, (6000, 3)) * [1, 1, 0]
    ramp = 4000 * points[:, :1]
    one, other = ((60 + ramp + 15 * rng.normal(size=(6000, 1))) * np.ones(3) for _ in range(2))
    assert np.corrcoef(one[:, 0], other[:, 0])[0, 1] > 0.85
    assert likeness(points, one.astype(np.float32), other.astype(np.float32)) < 0.43


def test_directions_that_no_plane_tells_of_stay() -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-0.01, 0.01, 5e-4), np.arange(-0.01, 0.01, 5e-4)))
    points = np.stack([x, y, np.zeros_like(x)], axis=1)
    plane = Surface(points, np.tile([0.0, 0.0, 1.0], (len(x), 1)), np.full((len(x), 3), 90, np.float32))
    start = pose(so3_exp(np.array([0.01, 0.0, 0.0])), np.array([2e-4, 1e-4, 5e-4]))
    found = refine(plane, plane, start)
    assert abs(found.T_target_source[2, 3]) < 1e-6
    np.testing.assert_allclose(found.T_target_source[:2, 3], start[:2, 3], atol=5e-5)
    assert found.rms_m < 1e-6


def test_colours_of_another_light_are_translated() -> None:
    map_ = scan(0.0, 0.006)
    light, other = Light(np.zeros(3), 0.05, (0.2, 0.0), 0.0283), Light(np.array([0.0, -0.01, 0.0]), 0.1, (0.1, 0.0), 0.04)
    own = replace(map_, light=light)
    under_other = relit(own, other)
    before, after = restore(own), restore(under_other)
    np.testing.assert_allclose(
        before.shown_colours(before.alive(), light, as_seen=False),
        after.shown_colours(after.alive(), other, as_seen=False),
        rtol=1e-4,
    )
    assert np.abs(under_other.columns.colour - own.columns.colour).max() > 5
