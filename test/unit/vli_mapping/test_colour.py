from __future__ import annotations

import numpy as np
from mapping_scenes import calibration

from vli_mapping.colour import colour_points

CAMERA = calibration().camera


def ramp() -> np.ndarray:
    """Return a BGR image whose blue grows with u, green with v."""
    v, u = np.mgrid[0:480, 0:640]
    return np.stack([u // 4, v // 4, np.full_like(u, 7)], axis=2).astype(np.uint8)


def at_pixel(u: float, v: float, depth: float = 0.03) -> np.ndarray:
    return np.array([[(u - 319.5) / 360 * depth, (v - 239.5) / 360 * depth, depth]])


def test_colour_is_rgb_and_bilinear() -> None:
    rgb = colour_points(CAMERA, at_pixel(403.5, 200.0), [(ramp(), np.eye(4))])
    np.testing.assert_allclose(rgb, [[7, 50, (100 + 101) / 2]], atol=1e-3)


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
    T[0, 3] = 4 / 360 * 0.03
    moved = colour_points(CAMERA, at_pixel(404, 200), [(ramp(), T)])
    np.testing.assert_allclose(moved[0, 2], 100, atol=1e-3)
