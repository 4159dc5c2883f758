"""Colours of a finished map: what normals, shadows and grazing light spoil at a point is told by its neighbourhood."""

from __future__ import annotations

import numpy as np
import pytest

from vli_common.arrays import BoolArray, FloatArray
from vli_mapping.albedo import albedo, finished_cloud, light_on
from vli_mapping.light import Light, irradiance
from vli_mapping.point_map import PointMap, Stripe

HEIGHT = 0.03
LIGHT = Light(np.array([-0.006, 0.0, 0.0]), 0.05, (0.2, 0.0), HEIGHT)
T_MAP_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])
T_MAP_CAMERA[2, 3] = HEIGHT
SPACING = 2e-4
RIDGE_X = 0.001


def seen(points: FloatArray, normals: FloatArray, rho: FloatArray, lit: BoolArray | None = None) -> FloatArray:
    """Return the colours (N, 3) that the light makes of points (N, 3) with true normals (N, 3) and albedo (N,)."""
    parameters = np.array([*LIGHT.position, LIGHT.ambient, *LIGHT.vignetting])
    local = (points - T_MAP_CAMERA[:3, 3]) @ T_MAP_CAMERA[:3, :3]
    turned = normals @ T_MAP_CAMERA[:3, :3]
    level = irradiance(parameters, local, turned, HEIGHT)
    if lit is not None:
        level = np.where(lit, level, LIGHT.ambient * LIGHT.vignette(local))
    axis = irradiance(parameters, np.array([[0.0, 0.0, HEIGHT]]), np.array([[0.0, 0.0, -1.0]]), HEIGHT)
    return 150.0 * (rho * level / axis)[:, None] * np.ones(3)


def mapped(points: FloatArray, normals: FloatArray, colours: FloatArray, solid: BoolArray | None = None) -> PointMap:
    """Return a map of these points, all by one view, in their order."""
    count, point_map = len(points), PointMap()
    every = np.ones(count, np.bool_)
    rows = point_map.insert(
        Stripe(
            stamp_ns=0,
            number=0,
            T_map_camera=T_MAP_CAMERA,
            points=points,
            normals=normals.astype(np.float32),
            planarity=np.ones(count, np.float32),
            colours=colours.astype(np.float32),
            sigma=np.full(count, 3e-5),
            solid=every if solid is None else solid,
        )
    )
    np.testing.assert_array_equal(rows, np.arange(count))
    return point_map


def grid(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return (N, 2) all pairs, along x first."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def floor() -> tuple[FloatArray, FloatArray]:
    """Return points and normals (N, 3) of 8 mm × 8 mm at z = 0."""
    at = grid(np.arange(-0.004, 0.004, SPACING), np.arange(-0.004, 0.004, SPACING))
    points = np.column_stack([at, np.zeros(len(at))])
    return points, np.tile([0.0, 0.0, 1.0], (len(points), 1))


def flank(degrees: float) -> tuple[FloatArray, FloatArray]:
    """Return points and normals (N, 3) of a plane that faces away from the light by so much, and is seen all the same."""
    at = grid(np.arange(-0.003, 0.003, SPACING), np.arange(-0.003, 0.003, SPACING))
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    points = np.column_stack([at[:, 0] * c, at[:, 1], -at[:, 0] * s])
    return points, np.tile([s, 0.0, c], (len(points), 1))


def shaken(normals: FloatArray, sigma: float) -> FloatArray:
    """Return normals (N, 3) with an error of ``sigma`` rad about each axis."""
    noisy = normals + np.random.default_rng(1).normal(size=normals.shape) * sigma
    return noisy / np.linalg.norm(noisy, axis=1, keepdims=True)


def spread(colours: FloatArray) -> float:
    """Return the RMS about the mean, in shares of it."""
    return float(colours.std() / colours.mean())


def test_normals_that_scatter_do_not_speckle_a_flank() -> None:
    points, normals = flank(60.0)
    point_map = mapped(points, shaken(normals, 0.08), seen(points, normals, np.ones(len(points))))
    every = np.arange(len(points))
    assert spread(point_map.shown_colours(every, LIGHT, as_seen=False)) > 0.1
    assert spread(albedo(point_map, LIGHT)) < 0.045


@pytest.mark.parametrize("degrees", [0.0, 40.0])
def test_on_what_faces_the_light_somehow_print_keeps_its_contrast(degrees: float) -> None:
    points, normals = flank(degrees)
    rho = np.where(np.abs(points[:, 1]) < 5e-4, 0.2, 1.0)
    found = albedo(mapped(points, shaken(normals, 0.05), seen(points, normals, rho)), LIGHT)[:, 0]
    assert found[rho == 0.2].mean() < 0.3 * found[rho == 1.0].mean()


@pytest.mark.parametrize("spoilt", ["normal", "solid"])
def test_a_point_without_a_normal_or_that_may_fly_takes_the_colour_of_those_around(spoilt: str) -> None:
    points, normals = floor()
    odd = np.zeros(len(points), np.bool_)
    odd[7::41] = True
    colours = seen(points, normals, np.ones(len(points)))
    colours[odd] *= 0.3
    solid = ~odd if spoilt == "solid" else np.ones(len(points), np.bool_)
    if spoilt == "normal":
        normals = np.where(odd[:, None], 0.0, normals)
    point_map = mapped(points, normals, colours)
    # Doubtful points do not enter where solid ones cover them: these lost their trust later.
    point_map.columns.solid[: len(points)] = solid
    found = albedo(point_map, LIGHT)[:, 0]
    assert found[odd].mean() > 0.75 * found[~odd].mean()
    assert found[~odd].min() > 0.9 * np.median(found[~odd])


def wall_and_floor() -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return points, normals and whether they are lit: a ridge that keeps the light from some of the floor behind it."""
    points, normals = floor()
    at = grid(np.arange(-0.004, 0.004, SPACING), np.arange(SPACING, 0.004, SPACING))
    ridge = np.column_stack([np.full(len(at), RIDGE_X), at])
    points, normals = np.concatenate([points, ridge]), np.concatenate([normals, np.tile([-1.0, 0.0, 0.0], (len(at), 1))])
    lamp = T_MAP_CAMERA[:3, :3] @ LIGHT.position + T_MAP_CAMERA[:3, 3]
    share = (RIDGE_X - points[:, 0]) / (lamp[0] - points[:, 0])
    height = points[:, 2] + share * (lamp[2] - points[:, 2])
    return points, normals, (points[:, 0] < RIDGE_X + 1e-9) | (height > 0.004 - SPACING)


def test_where_nothing_around_has_a_normal_the_nearest_that_is_trusted_gives_the_colour() -> None:
    points, normals = floor()
    wall, wall_normals = flank(85.0)
    wall += np.array([0.012, 0.0, -0.004])
    every, turned = np.concatenate([points, wall]), np.concatenate([normals, wall_normals])
    is_wall = np.arange(len(every)) >= len(points)
    colours = seen(every, turned, np.full(len(every), 0.6))
    point_map = mapped(every, np.where(is_wall[:, None], 0.0, turned), colours, ~is_wall)
    rho = albedo(point_map, LIGHT).mean(axis=1)
    of_floor = np.median(rho[~is_wall])
    alone = mapped(wall, np.zeros_like(wall), colours[is_wall])
    assert np.median(albedo(alone, LIGHT)) < 0.5 * of_floor
    np.testing.assert_allclose(rho[is_wall], of_floor, rtol=0.3)


def test_what_stands_in_the_way_of_the_light_is_found() -> None:
    points, normals, lit = wall_and_floor()
    point_map = mapped(points, normals, seen(points, normals, np.ones(len(points)), lit))
    _, found = light_on(point_map, LIGHT, np.arange(len(points)), normals.astype(np.float32))
    # At the border of the shadow a ray passes the ridge nearer than the search is wide.
    clear = lit & ((points[:, 0] < RIDGE_X) | (points[:, 0] > RIDGE_X + 0.0016))
    dark = ~lit & (points[:, 0] > RIDGE_X + 4e-4)
    assert dark.sum() > 100
    assert clear.sum() > 1000
    assert found[dark].mean() > 0.9
    assert found[clear].mean() < 0.02


def test_a_narrow_shadow_is_filled_from_beside_it() -> None:
    points, normals, lit = wall_and_floor()
    point_map = mapped(points, normals, seen(points, normals, np.ones(len(points)), lit))
    every, on_floor = np.arange(len(points)), points[:, 2] == 0
    dark = on_floor & ~lit
    by_itself, found = point_map.shown_colours(every, LIGHT, as_seen=False)[:, 0], albedo(point_map, LIGHT)[:, 0]
    level = np.median(found[on_floor & lit])
    assert np.median(by_itself[dark]) < 0.3 * level
    assert np.median(found[dark]) > 0.7 * level


def test_what_no_image_saw_stays_unknown_and_spoils_nothing() -> None:
    points, normals = floor()
    colours = seen(points, normals, np.ones(len(points)))
    colours[::5] = np.nan
    found = albedo(mapped(points, normals, colours), LIGHT)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(colours))
    assert spread(found[np.isfinite(found[:, 0])]) < 0.02


def test_without_a_light_and_as_seen_a_finished_cloud_is_that_of_single_points() -> None:
    points, normals = floor()
    point_map = mapped(points, normals, seen(points, normals, np.linspace(0.2, 1.0, len(points))))
    for light, as_seen in ((None, False), (LIGHT, True)):
        expected = point_map.cloud(light=light, as_seen=as_seen)
        np.testing.assert_array_equal(finished_cloud(point_map, light, as_seen).colours, expected.colours)
    assert len(finished_cloud(PointMap(), LIGHT, as_seen=False)) == 0


def test_points_that_left_are_no_neighbours() -> None:
    points, normals = floor()
    colours = seen(points, normals, np.ones(len(points)))
    bad = np.arange(0, len(points), 2)
    colours[bad] = 0.0
    point_map = mapped(points, normals, colours)
    point_map.remove(bad)
    alone = mapped(np.delete(points, bad, axis=0), np.delete(normals, bad, axis=0), np.delete(colours, bad, axis=0))
    np.testing.assert_array_equal(albedo(point_map, LIGHT), albedo(alone, LIGHT))
