from __future__ import annotations

import cv2
import numpy as np
from mapping_scenes import calibration

from vli_mapping.colour import colour_points, sight

CAMERA = calibration().camera


def ramp() -> np.ndarray:
    """Return a BGR image whose blue grows with u, green with v."""
    v, u = np.mgrid[0:480, 0:640]
    return np.stack([np.clip(u - 300, 0, 255), np.clip(v - 150, 0, 255), np.full_like(u, 7)], axis=2).astype(np.uint8)


def at_pixel(u: float, v: float, depth: float = 0.03) -> np.ndarray:
    return np.array([[(u - 319.5) / 360 * depth, (v - 239.5) / 360 * depth, depth]])


def test_colour_is_rgb_and_bilinear() -> None:
    rgb = colour_points(CAMERA, at_pixel(403.5, 200.0), [(ramp(), np.eye(4))])
    np.testing.assert_allclose(rgb, [[7, 50, 103.5]], atol=1e-3)


def test_views_are_averaged_and_those_that_do_not_show_a_point_are_left_out() -> None:
    away = np.eye(4)
    away[0, 3] = 1.0
    views = [(np.full((480, 640, 3), 10, np.uint8), np.eye(4)), (np.full((480, 640, 3), 20, np.uint8), np.eye(4))]
    np.testing.assert_allclose(colour_points(CAMERA, at_pixel(300, 200), views), [[15, 15, 15]])
    hidden = [*views, (np.full((480, 640, 3), 200, np.uint8), away)]
    np.testing.assert_allclose(colour_points(CAMERA, at_pixel(300, 200), hidden), [[15, 15, 15]])


def test_a_point_outside_every_view_or_behind_has_no_colour() -> None:
    points = np.concatenate([at_pixel(-1, 200), at_pixel(640, 200), at_pixel(300, 480), [[0, 0, -0.03]]])
    assert np.isnan(colour_points(CAMERA, points, [(ramp(), np.eye(4))])).all()
    assert np.isnan(colour_points(CAMERA, points, [])).all()


def test_a_grey_image_gives_grey() -> None:
    grey = np.full((480, 640), 99, np.uint8)
    np.testing.assert_allclose(colour_points(CAMERA, at_pixel(10, 10), [(grey, np.eye(4))]), [[99, 99, 99]])


def test_the_pose_of_the_view_counts() -> None:
    T = np.eye(4)
    T[0, 3] = 1 / 360 * 0.03
    moved = colour_points(CAMERA, at_pixel(404, 200), [(ramp(), T)])
    np.testing.assert_allclose(moved[0, 2], 103, atol=1e-3)


def test_a_saturated_view_counts_only_where_there_is_no_other() -> None:
    views = [(np.full((480, 640, 3), 255, np.uint8), np.eye(4)), (np.full((480, 640, 3), 90, np.uint8), np.eye(4))]
    np.testing.assert_allclose(colour_points(CAMERA, at_pixel(300, 200), views), [[90, 90, 90]], atol=0.5)
    np.testing.assert_allclose(colour_points(CAMERA, at_pixel(300, 200), views[:1]), [[255, 255, 255]], atol=1e-3)


def test_a_blurred_print_is_sharpened_and_flat_colour_kept() -> None:
    sharp = np.full((480, 640), 50, np.uint8)
    sharp[:, 320:] = 150
    blurred = cv2.GaussianBlur(sharp, (0, 0), 1.0)
    points = np.concatenate([at_pixel(u, 200.0) for u in np.arange(310.0, 330.0, 0.5)])
    truth = np.where(np.arange(310.0, 330.0, 0.5) < 319.5, 50, 150)
    colours = colour_points(CAMERA, points, [(blurred, np.eye(4))])[:, 0]
    plain = np.array([blurred[200, int(u)] for u in np.arange(310.0, 330.0, 0.5)], float)
    assert np.abs(colours - truth).sum() < 0.85 * np.abs(plain - truth).sum()
    np.testing.assert_allclose(colours[:12], 50, atol=1)


def test_spots_are_sighted_only_where_they_face_two_views_and_are_well_exposed() -> None:
    grey, dark = np.full((480, 640, 3), 100, np.uint8), np.zeros((480, 640, 3), np.uint8)
    points = np.concatenate([at_pixel(300, 200), at_pixel(310, 200), at_pixel(320, 200)])
    normals = np.array([[0, 0, -1], [1, 0, 0], [0, 0, 0]], np.float32)
    twice = sight(CAMERA, points, normals, [(grey, np.eye(4)), (grey, np.eye(4)), (dark, np.eye(4))])
    np.testing.assert_array_equal(twice.spot, [0, 0])
    np.testing.assert_allclose(twice.level, 100)
    np.testing.assert_allclose(twice.points, points[[0, 0]])
    assert len(sight(CAMERA, points, normals, [(grey, np.eye(4)), (dark, np.eye(4))]).spot) == 0
    assert len(sight(CAMERA, points, normals, []).spot) == 0


def test_a_view_in_which_something_nearer_is_in_front_counts_only_where_there_is_no_other() -> None:
    point, in_front = at_pixel(300, 200), at_pixel(300.4, 200.3, depth=0.025)
    aside = np.eye(4)
    aside[0, 3] = 2e-3
    hidden, open_view = (np.full((480, 640, 3), 10, np.uint8), np.eye(4)), (np.full((480, 640, 3), 90, np.uint8), aside)
    np.testing.assert_allclose(colour_points(CAMERA, point, [hidden, open_view]), [[50, 50, 50]])
    np.testing.assert_allclose(colour_points(CAMERA, point, [hidden, open_view], in_front), [[90, 90, 90]], atol=0.2)
    np.testing.assert_allclose(colour_points(CAMERA, point, [hidden], in_front), [[10, 10, 10]], atol=1e-3)


def test_a_surface_does_not_hide_itself_and_points_behind_or_outside_hide_nothing() -> None:
    flank = np.concatenate([at_pixel(300 + k, 200, depth=0.03 + 3e-4 * k) for k in range(20)])
    view = [(ramp(), np.eye(4))]
    alone = np.concatenate([colour_points(CAMERA, point[None], view) for point in flank])
    odd = np.concatenate([[[0, 0, -0.03]], at_pixel(-50, 200, depth=0.01)])
    np.testing.assert_allclose(colour_points(CAMERA, flank, view, odd), alone, atol=1e-3)
