"""Albedo by all images that are kept of a scan: a plane under the light on board, photographed from several places."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from vli_common.arrays import ByteArray, FloatArray
from vli_common.camera import CameraModel, make_camera
from vli_common.types import Image
from vli_mapping import photographs
from vli_mapping.albedo import albedo
from vli_mapping.light import Light, irradiance
from vli_mapping.photographs import Album, Photograph, develop
from vli_mapping.point_map import PointMap, Stripe

HEIGHT = 0.04
LIGHT = Light(np.array([-0.006, 0.002, 0.0]), 0.05, (0.2, 0.0), HEIGHT)
CAMERA = make_camera("none", (200.0, 200.0, 79.5, 59.5), (), (160, 120))
FISHEYE = make_camera("equidistant", (110.0, 110.0, 79.5, 59.5), (0.0, 0.0, 0.0, 0.0), (160, 120))
CLOSE_UP = make_camera("none", (750.0, 750.0, 159.5, 119.5), (), (320, 240))
"""A pixel is 0.05 mm."""
BRIGHT, DARK, GREY = 0.9, 0.3, 180.0
SPACING = 2e-4


def looking_down(x: float, y: float, tilt_deg: float = 0.0, height: float = HEIGHT) -> FloatArray:
    """Return ``T_map_camera`` (4, 4) above the plane z = 0, turned about the camera's y axis."""
    c, s = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    T[:3, 3] = [x, y, height]
    return T


PLACES = [looking_down(-0.006, 0.0), looking_down(0.0, 0.004, 10.0), looking_down(0.006, -0.002, -15.0)]


def stripes(xy: FloatArray) -> FloatArray:
    """Return the albedo (N,) of places (N, 2) on the plane: stripes 4 mm wide."""
    return np.where(np.floor(xy[:, 0] / 0.004) % 2 == 0, BRIGHT, DARK)


def picture(
    T_map_camera: FloatArray, camera: CameraModel = CAMERA, colour: bool = True, rho: Callable[[FloatArray], FloatArray] = stripes
) -> ByteArray:
    """Return what a camera sees of the plane, of an albedo ``rho``, under the light on board."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.column_stack([camera.unproject(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)), np.ones(u.size)])
    turned = rays @ T_map_camera[:3, :3].T
    local = rays * (-T_map_camera[2, 3] / turned[:, 2])[:, None]
    grey = GREY * rho((local @ T_map_camera[:3, :3].T + T_map_camera[:3, 3])[:, :2]) * shading(local, T_map_camera)
    plain = np.clip(np.rint(grey), 0, 255).astype(np.uint8).reshape(v.shape)
    return np.stack([plain // 2, plain, plain], axis=2) if colour else plain


def shading(local: FloatArray, T_map_camera: FloatArray) -> FloatArray:
    """Return E (N,) of points of the plane, camera frame, relative to the reference."""
    parameters = np.array([*LIGHT.position, LIGHT.ambient, *LIGHT.vignetting])
    normals = np.tile(T_map_camera[2, :3], (len(local), 1))
    axis = irradiance(parameters, np.array([[0.0, 0.0, HEIGHT]]), np.array([[0.0, 0.0, -1.0]]), HEIGHT)
    result: FloatArray = irradiance(parameters, local, normals, HEIGHT) / axis
    return result


def photographed(places: list[FloatArray], camera: CameraModel = CAMERA, colour: bool = True) -> list[Photograph]:
    return [Photograph.of(picture(T, camera, colour), T, HEIGHT) for T in places]


def plane(half: float = 0.008, height: float = 0.0) -> FloatArray:
    """Return points (N, 3)."""
    along = np.arange(-half, half, SPACING)
    x, y = np.meshgrid(along, along)
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height)])


def mapped(points: FloatArray, colours: FloatArray | None = None) -> PointMap:
    """Return a map of points (N, 3) that no image, or one at the first place, has coloured."""
    count, point_map = len(points), PointMap()
    point_map.insert(
        Stripe(
            stamp_ns=0,
            number=0,
            T_map_camera=PLACES[0],
            points=points,
            normals=np.tile(np.float32([0, 0, 1]), (count, 1)),
            planarity=np.ones(count, np.float32),
            colours=np.full((count, 3), np.nan, np.float32) if colours is None else colours.astype(np.float32),
            sigma=np.full(count, 3e-5),
            solid=np.ones(count, np.bool_),
        )
    )
    return point_map


def within(points: FloatArray) -> FloatArray:
    """Return which points (N, 3) are clear of the borders between the stripes."""
    return np.abs((points[:, 0] / 0.004 + 0.5) % 1.0 - 0.5) > 0.25


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["pinhole", "fisheye"])
def test_photographs_tell_the_albedo_whatever_the_light_was(camera: CameraModel) -> None:
    points = plane()
    point_map = mapped(points)
    develop(point_map, LIGHT, camera, photographed(PLACES, camera))
    c, clear = point_map.columns, within(points)
    expected = GREY * stripes(points)
    assert (c.albedo_weight[: len(points)] > 0).all()
    np.testing.assert_allclose(c.albedo[: len(points)][clear, 0], expected[clear], rtol=0.06)
    np.testing.assert_allclose(c.albedo[: len(points)][clear, 2], 0.5 * expected[clear], rtol=0.08, atol=3.0)


def test_grey_images_give_grey() -> None:
    points = plane()
    point_map = mapped(points)
    develop(point_map, LIGHT, CAMERA, photographed(PLACES, colour=False))
    shown = point_map.columns.albedo[: len(points)]
    np.testing.assert_array_equal(shown[:, 0], shown[:, 2])
    assert shown.min() > 0.5 * GREY * DARK


def test_what_the_images_of_the_scan_missed_or_saw_in_poor_light_is_as_they_show_it() -> None:
    points = plane()
    poor = np.full((len(points), 3), 5.0)
    unseen, spoilt = mapped(points), mapped(points, poor)
    for point_map in (unseen, spoilt):
        develop(point_map, LIGHT, CAMERA, photographed(PLACES))
    clear, expected = within(points), GREY * stripes(points)
    np.testing.assert_allclose(albedo(unseen, LIGHT)[clear, 0], expected[clear], rtol=0.12)
    # One view of four says otherwise: its share of the albedo is no more than its share of the light.
    assert np.median(np.abs(albedo(spoilt, LIGHT)[clear, 0] / expected[clear] - 1.0)) < 0.4


def test_print_keeps_its_contrast_where_photographs_agree() -> None:
    points = plane()
    point_map = mapped(points)
    develop(point_map, LIGHT, CAMERA, photographed(PLACES))
    found, clear = albedo(point_map, LIGHT)[:, 0], within(points)
    dark = stripes(points) == DARK
    assert found[clear & dark].mean() < 1.1 * DARK / BRIGHT * found[clear & ~dark].mean()


def strokes(width: float) -> Callable[[FloatArray], FloatArray]:
    """Return the albedo of places (N, 2): bright, but for dark strokes 1.5 mm apart, crossed by one."""

    def rho(xy: FloatArray) -> FloatArray:
        along, across = (xy[:, 0] + 7.5e-4) % 1.5e-3 - 7.5e-4, xy[:, 1]
        return np.where((np.abs(along) < width / 2) | (np.abs(across) < width / 2), DARK, BRIGHT)

    return rho


def misregistered(rho: Callable[[FloatArray], FloatArray]) -> list[Photograph]:
    """Return photographs as they are in a scan: blurred, noisy, and each off by a pixel and a half to its own side."""
    rng, off = np.random.default_rng(3), 1.5 * HEIGHT / CLOSE_UP.fx
    result = []
    for number, (x, y) in enumerate([(-0.002, -0.001), (0.0, 0.0), (0.003, 0.001), (0.001, -0.002), (-0.001, 0.002)]):
        T = looking_down(x, y)
        blurred = cv2.GaussianBlur(picture(T, CLOSE_UP, rho=rho).astype(np.float32), (0, 0), 1.0)
        pixels = np.clip(np.rint(blurred + rng.normal(0.0, 2.0, blurred.shape)), 0, 255).astype(np.uint8)
        believed, angle = T.copy(), 2 * np.pi * number / 5
        believed[:2, 3] += off * np.array([np.cos(angle), np.sin(angle)])
        result.append(Photograph.of(pixels, believed, HEIGHT))
    return result


def scattered() -> tuple[PointMap, FloatArray]:
    """Return a map of a part of the plane that most photographs show, and its points (N, 3), not on the grid of the print."""
    points = plane(0.004)
    points[:, :2] += np.random.default_rng(5).uniform(-0.5, 0.5, (len(points), 2)) * SPACING
    point_map = mapped(points)
    return point_map, point_map.columns.position[: point_map.rows]


@pytest.mark.parametrize("width", [3e-4, 4e-4, 5e-4])
def test_dark_strokes_keep_their_contrast_where_photographs_are_off_by_a_pixel(width: float) -> None:
    point_map, points = scattered()
    develop(point_map, LIGHT, CLOSE_UP, misregistered(strokes(width)))
    dark, bright = strokes(width)(points[:, :2]) == DARK, strokes(width + 3e-4)(points[:, :2]) == BRIGHT
    by_photographs, found = point_map.columns.albedo[: len(points), 0], albedo(point_map, LIGHT)[:, 0]
    assert np.isfinite(found).all()
    shown = by_photographs[bright].mean() - by_photographs[dark].mean()
    assert shown > 0.5 * GREY * (BRIGHT - DARK)
    assert found[bright].mean() - found[dark].mean() > 0.9 * shown


def test_a_strip_of_wrong_normals_takes_the_level_around() -> None:
    point_map, points = scattered()
    strip = np.abs(points[:, 1] - 0.0015) < 5e-4
    point_map.columns.normal[: len(points)][strip] = [np.sin(np.radians(60.0)), 0.0, np.cos(np.radians(60.0))]
    develop(point_map, LIGHT, CLOSE_UP, misregistered(strokes(0.0)))
    by_photographs, found = point_map.columns.albedo[: len(points), 0], albedo(point_map, LIGHT)[:, 0]
    middle = np.abs(points[:, 1] - 0.0015) < 3e-4
    assert by_photographs[middle].mean() > 2.0 * GREY * BRIGHT
    assert found[middle].mean() < 1.3 * GREY * BRIGHT


def test_a_wrong_normal_is_told_by_photographs_that_do_not_agree() -> None:
    points = plane()
    point_map = mapped(points)
    tilted = np.linalg.norm(points[:, :2] - [0.002, 0.002], axis=1) < 8e-4
    point_map.columns.normal[: len(points)][tilted] = [0.8, 0.0, 0.6]
    develop(point_map, LIGHT, CAMERA, photographed(PLACES))
    c = point_map.columns
    level, weight = c.albedo[: len(points)].mean(axis=1), c.albedo_weight[: len(points)]
    misfit = 1.0 - level**2 * weight / c.albedo_power[: len(points)]
    centre = np.linalg.norm(points[:, :2] - [0.002, 0.002], axis=1) < 4e-4
    assert np.median(misfit[centre]) > 5 * np.median(misfit[~tilted])


def test_a_point_outside_all_photographs_or_behind_the_surface_is_not_told_of() -> None:
    shown, hidden, far = plane(0.004), plane(0.002, -0.003), plane(0.002) + np.array([0.2, 0.0, 0.0])
    points = np.concatenate([shown, hidden, far])
    point_map = mapped(points)
    develop(point_map, LIGHT, CAMERA, photographed([looking_down(0.0, 0.0)]))
    weight = point_map.columns.albedo_weight[: len(points)]
    assert (weight[: len(shown)] > 0).all()
    assert not weight[len(shown) :].any()


def test_saturated_pixels_tell_nothing() -> None:
    point_map = mapped(plane())
    white = np.full((CAMERA.height, CAMERA.width, 3), 255, np.uint8)
    develop(point_map, LIGHT, CAMERA, [Photograph.of(white, PLACES[0], HEIGHT)])
    assert not point_map.columns.albedo_weight[: point_map.rows].any()


def test_one_after_another_photographs_tell_what_they_tell_together() -> None:
    points = plane()
    together, apart = mapped(points), mapped(points)
    develop(together, LIGHT, CAMERA, photographed(PLACES))
    for one in photographed(PLACES):
        develop(apart, LIGHT, CAMERA, [one])
    for name in ("albedo", "albedo_weight", "albedo_power"):
        first, second = (getattr(item.columns, name)[: len(points)] for item in (together, apart))
        np.testing.assert_allclose(first, second, rtol=1e-5)


@pytest.mark.parametrize("light", [None, LIGHT])
def test_without_a_light_or_a_photograph_nothing_changes(light: Light | None) -> None:
    point_map = mapped(plane())
    develop(point_map, light, CAMERA, [] if light else photographed(PLACES))
    assert not point_map.columns.albedo_weight[: point_map.rows].any()


def test_a_row_that_is_used_again_has_no_albedo() -> None:
    point_map = mapped(plane())
    develop(point_map, LIGHT, CAMERA, photographed(PLACES))
    count = point_map.rows
    point_map.remove(point_map.alive())
    again = mapped(plane() + np.array([0.05, 0.0, 0.0]))
    rows = point_map.insert(
        Stripe(1, 1, PLACES[0], *(getattr(again.columns, name)[:count] for name in ("position", "normal", "planarity", "colour")),
               np.full(count, 3e-5), np.ones(count, np.bool_))
    )  # fmt: skip
    assert point_map.rows == count
    assert not point_map.columns.albedo_weight[rows].any()
    assert not point_map.columns.albedo_power[rows].any()


def test_points_that_join_average_what_is_known_of_them() -> None:
    points = plane(0.002)
    first, second = mapped(points), mapped(points)
    develop(first, LIGHT, CAMERA, photographed(PLACES[:1]))
    develop(second, LIGHT, CAMERA, photographed(PLACES[1:]))
    both = mapped(points)
    develop(both, LIGHT, CAMERA, photographed(PLACES))
    count = len(points)
    target = np.arange(count)
    target[0] = -1
    first.add_albedo(target, second.columns.at(slice(count)))
    for name in ("albedo", "albedo_weight", "albedo_power"):
        found, expected = (getattr(item.columns, name)[1:count] for item in (first, both))
        np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert first.columns.albedo_weight[0] < both.columns.albedo_weight[0]


def test_an_album_keeps_what_looks_from_elsewhere() -> None:
    album = Album()
    image = Image(0, picture(PLACES[0]))
    for x in (0.0, 0.0005, 0.001, 0.01):
        album.offer(image, looking_down(x, 0.0), HEIGHT)
    album.offer(image, looking_down(0.01, 0.0, 20.0), HEIGHT)
    assert [item.T_map_camera[0, 3] for item in album.photographs] == [0.0, 0.01, 0.01]


def test_an_album_is_bounded_and_stays_spread_over_the_scan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(photographs, "_MOST", 8)
    album, image = Album(), Image(0, picture(PLACES[0]))
    for step in range(100):
        album.offer(image, looking_down(0.005 * step, 0.0), HEIGHT)
        assert len(album.photographs) <= 8
    places = [item.T_map_camera[0, 3] for item in album.photographs]
    assert places[0] == 0.0
    assert places[-1] > 0.4
    assert max(np.diff(places)) < 0.15


def test_a_photograph_is_nearly_the_image() -> None:
    pixels = picture(PLACES[1])
    back = photographed([PLACES[1]])[0].pixels()
    assert back.shape == pixels.shape
    assert np.abs(back.astype(int) - pixels).mean() < 2.0
