"""The images against geometry that is known in closed form."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from flat_scene import SMALL, flat, plain_scene

from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, pose, so3_exp, transform
from vli_simulation.config import make_config
from vli_simulation.mesh import join
from vli_simulation.render import Renderer, View
from vli_simulation.rig import Rig, make_rig
from vli_simulation.simulate import Simulation

DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
STILL = np.zeros(3)


Triple = tuple[float, float, float]


def _view(position: Triple, turn: Triple = (0, 0, 0), velocity: FloatArray = STILL) -> View:
    return View(pose(DOWN @ so3_exp(np.array(turn)), np.array(position)), velocity, STILL)


def _grey_rig(rig: Rig) -> Rig:
    """Return the rig with a laser that all pixels of the mosaic see alike."""
    return dataclasses.replace(rig, laser=dataclasses.replace(rig.laser, response=np.ones(3)))


def _stripe_centres(image: FloatArray, along_rows: bool) -> FloatArray:
    """Return the centroid of the stripe in each column (or row): pixels (N, 2)."""
    image = image if along_rows else image.T
    index = np.arange(image.shape[0])[:, None]
    total = image.sum(axis=0)
    good = total > 0.3 * total.max()
    centre = (image * index).sum(axis=0)[good] / total[good]
    pixels = np.stack([np.flatnonzero(good), centre], axis=1)
    return pixels if along_rows else pixels[:, ::-1]


def _triangulate(rig: Rig, view: View, pixels: FloatArray) -> FloatArray:
    rays = np.column_stack([rig.camera.unproject(pixels), np.ones(len(pixels))])
    depth = -rig.laser.d / (rays @ rig.laser.normal)
    return transform(view.T_world_cam, depth[:, None] * rays)


@pytest.mark.parametrize(("lens", "angle"), [("radtan", 0.0), ("equidistant", 0.0), ("none", 90.0)])
def test_the_stripe_triangulates_to_the_surface(lens: str, angle: float) -> None:
    changes = {**SMALL, "rig.lens": lens, "rig.stripe_angle_deg": angle, "sensor.speckle": 0.0, "sensor.vignetting": 0.0}
    config = make_config("smoke", changes)
    rig = _grey_rig(make_rig(config, 2))
    renderer = Renderer(plain_scene(flat()), rig, config, 2)
    view = _view((0.001, 0.002, 0.031), (0.1, -0.15, 0.3))
    on = renderer.short_frame(view, np.random.default_rng(0)).astype(np.float64)
    dark = dataclasses.replace(rig, laser=dataclasses.replace(rig.laser, response=np.full(3, 1e-9)))
    off = Renderer(plain_scene(flat()), dark, config, 2).short_frame(view, np.random.default_rng(0))
    pixels = _stripe_centres(np.clip(on - off, 0, None), along_rows=angle == 0.0)[4:-4]
    points = _triangulate(rig, view, pixels)
    assert len(points) > 150
    assert np.abs(points[:, 2]).max() < 2e-5


def test_the_stripe_on_the_keyboard_lies_on_the_keys(keyboard: Simulation) -> None:
    view = keyboard.view(61)
    rig = _grey_rig(keyboard.rig)
    config = make_config("smoke", {**SMALL, "sensor.speckle": 0.0, "sensor.vignetting": 0.0})
    image = Renderer(keyboard.scene, rig, config, 3).short_frame(view, np.random.default_rng(0))
    peak = np.argmax(image, axis=0)
    columns = np.flatnonzero(image.max(axis=0) > 100)
    rows = []
    for column in columns:
        window = np.arange(max(peak[column] - 5, 0), min(peak[column] + 6, image.shape[0]))
        light = np.clip(image[window, column] - 25, 0, None)
        rows.append((light * window).sum() / light.sum())
    pixels = np.column_stack([columns, rows])
    points = _triangulate(rig, view, pixels)
    rays = transform(inverse(view.T_world_cam), points) @ view.T_world_cam[:3, :3].T
    hits = keyboard.renderer.caster.cast(view.eye, rays)
    error = np.abs(hits.distance - 1) * np.linalg.norm(rays, axis=1)
    assert len(points) > 120
    # Where the stripe crosses an edge its centroid is pulled aside, as it is in reality.
    assert np.median(error) < 2e-5


def test_seen_points_lie_in_the_plane_on_the_surface_and_in_view(keyboard: Simulation) -> None:
    view = keyboard.view(61)
    seen = keyboard.renderer.seen(view)
    in_camera = transform(inverse(view.T_world_cam), seen.points)
    assert len(seen.points) > 500
    assert np.abs(in_camera @ keyboard.rig.laser.normal + keyboard.rig.laser.d).max() < 1e-7
    hits = keyboard.renderer.caster.cast(view.eye, seen.points - view.eye)
    assert np.abs(hits.distance - 1).max() < 2.1e-3
    assert np.median(np.abs(hits.distance - 1)) < 1e-5


def _dots() -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.uint8]], FloatArray]:
    """Return a tile of soft dots and their centres in units of the tile."""
    size = 1200
    at = (np.arange(12) + 0.5) / 12
    u, v = (grid.ravel() for grid in np.meshgrid(at, at))
    y, x = np.mgrid[:size, :size]
    period = size / 12
    dx, dy = (x + 0.5) % period - period / 2, (y + 0.5) % period - period / 2
    tile = 255 * np.exp(-0.5 * (dx**2 + dy**2) / 6.0**2)
    return np.round(tile).astype(np.uint8)[None], np.stack([u, v], axis=1)


@pytest.mark.parametrize("lens", ["radtan", "equidistant", "none"])
@pytest.mark.parametrize("speed", [0.0, 0.06])
def test_printed_dots_appear_where_they_project(lens: str, speed: float) -> None:
    config = make_config("smoke", {**SMALL, "rig.lens": lens, "sensor.vignetting": 0.0})
    rig = make_rig(config, 5)
    tiles, centres = _dots()
    renderer = Renderer(plain_scene(flat(tile=0, printed=0.03), tiles), rig, config, 5)
    view = _view((0.002, -0.001, 0.032), (0.12, 0.07, 0.4), np.array([speed, 0.5 * speed, 0.0]))
    image = renderer.long_frame(view).astype(np.float64)
    # The tile is 60 mm wide.
    dots = np.column_stack([(centres - 0.5) * 0.06, np.zeros(len(centres))])
    pixels = rig.camera.project(transform(inverse(view.T_world_cam), dots))
    inside = np.all((pixels > 12) & (pixels < [307, 227]), axis=1)
    errors = []
    for u, v in pixels[inside]:
        i, j = round(v), round(u)
        y, x = np.mgrid[i - 8 : i + 9, j - 8 : j + 9]
        patch = image[i - 8 : i + 9, j - 8 : j + 9]
        border = np.hypot(x - u, y - v) > 6.0
        basis = np.column_stack([x.ravel() - u, y.ravel() - v, np.ones(x.size)])
        light = basis @ np.linalg.lstsq(basis[border.ravel()], patch.ravel()[border.ravel()], rcond=None)[0]
        ink = np.clip(1 - patch.ravel() / light, 0, None) * (np.hypot(x - u, y - v).ravel() < 6.0)
        errors.append([(ink * (x.ravel() - u)).sum() / ink.sum(), (ink * (y.ravel() - v)).sum() / ink.sum()])
    assert len(errors) > 15
    assert np.abs(np.mean(errors, axis=0)).max() < 0.02
    assert np.abs(errors).max() < 0.05


def test_a_moving_camera_smears_along_its_motion_only() -> None:
    config = make_config("smoke", {**SMALL, "rig.lens": "none", "sensor.exposure_long_s": 0.02})
    tiles, _ = _dots()
    renderer = Renderer(plain_scene(flat(tile=0, printed=0.03), tiles), make_rig(config, 5), config, 5)
    sharp = renderer.long_frame(_view((0, 0, 0.03)))
    moved = renderer.long_frame(_view((0, 0, 0.03), velocity=np.array([0.03, 0.0, 0.0])))
    gradients = [[np.abs(np.diff(image, 2, axis)[60:-60, 60:-60]).mean() for axis in (0, 1)] for image in (sharp, moved)]
    assert gradients[1][1] < 0.8 * gradients[0][1]
    assert gradients[1][0] == pytest.approx(gradients[0][0], rel=0.1)


def test_every_second_pixel_gives_the_same_image_as_every_pixel(keyboard: Simulation) -> None:
    view = keyboard.view(60)
    renderer = keyboard.renderer
    exact = renderer._look(view, renderer._lens.rays)
    buffer, rough = renderer._interpolated(view)
    assert rough.mean() < 0.35
    assert np.abs(buffer.depth - exact.depth)[~rough].max() < 1e-4
    assert np.quantile(np.abs(buffer.depth - exact.depth)[~rough], 0.99) < 3e-5
    albedo, exact_albedo = renderer._albedo(buffer)[~rough], renderer._albedo(exact)[~rough]
    assert np.abs(albedo - exact_albedo).mean() < 2e-3


def test_light_falls_off_with_the_square_of_the_distance() -> None:
    config = make_config("smoke", SMALL)
    renderer = Renderer(plain_scene(flat()), dataclasses.replace(make_rig(config, 1), light=np.zeros(3)), config, 1)
    near, far = (renderer.long_frame(_view((0, 0, z)))[100:140, 140:180].mean() for z in (0.03, 0.06))
    # A twentieth of ambient light does not fall off with the square.
    assert near / far == pytest.approx(4.0, rel=0.12)


def test_a_step_hides_part_of_the_stripe_and_casts_a_shadow() -> None:
    config = make_config("smoke", {**SMALL, "sensor.speckle": 0.0, "rig.lens": "none"})
    rig = make_rig(config, 1)
    shelf = flat(0.008, 0.012)
    shelf.vertices[:, 0] -= 0.004
    for mesh, hidden in ((flat(), False), (join([flat(), shelf]), True)):
        renderer = Renderer(plain_scene(mesh), rig, config, 1)
        seen = renderer.seen(_view((0, 0, 0.035)))
        low = seen.points[np.abs(seen.points[:, 2]) < 1e-6]
        gap = np.diff(np.sort(low[:, 0])).max()
        assert (gap > 0.012) == hidden
        if hidden:
            assert np.count_nonzero(np.abs(seen.points[:, 2] - 0.012) < 1e-6) > 50


def test_static_views_give_identical_light(keyboard: Simulation) -> None:
    first, second = (keyboard.renderer.long_frame(keyboard.view(index)) for index in (0, 10))
    assert np.abs(first - second).max() < 0.6
    assert np.abs(first - second).mean() < 1e-3


def test_the_laser_is_bright_only_on_the_band(keyboard: Simulation) -> None:
    view = keyboard.view(61)
    image = keyboard.renderer.short_frame(view, np.random.default_rng(1))
    pixels = keyboard.rig.camera.project(transform(inverse(view.T_world_cam), keyboard.renderer.seen(view).points))
    mask = np.zeros(image.shape, np.uint8)
    mask[tuple(np.clip(np.round(pixels[:, ::-1]).astype(int), 0, np.array(image.shape) - 1).T)] = 1
    near = cv2.dilate(mask, np.ones((25, 25), np.uint8)) > 0
    assert image[~near].max() < 30
    assert image[mask > 0].mean() > 60
