"""Camera models: there and back over the whole image, and the same numbers as OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vli_common.camera import CameraModel, make_camera

INTRINSICS = (362.4, 363.1, 323.7, 236.9)
LENSES = {
    "none": ("none", ()),
    "radtan with four coefficients": ("radtan", (-0.118, 0.017, 0.0007, -0.0005)),
    "radtan with k3": ("radtan", (-0.28, 0.09, -0.0004, 0.0006, -0.005)),
    "barrel of a wide lens": ("radtan", (-0.30, 0.12, 0.0, 0.0, -0.008)),
    "equidistant": ("equidistant", (0.02, -0.011, 0.006, -0.002)),
}


def camera_of(lens: str) -> CameraModel:
    model, coefficients = LENSES[lens]
    return make_camera(model, INTRINSICS, coefficients, (640, 480))


def every_pixel() -> np.ndarray:
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    return np.stack([u.ravel(), v.ravel()], axis=1)


@pytest.mark.parametrize("lens", LENSES)
def test_every_pixel_of_the_image_comes_back_from_its_ray(lens: str) -> None:
    camera, pixels = camera_of(lens), every_pixel()
    np.testing.assert_allclose(camera.to_pixels(camera.unproject(pixels)), pixels, rtol=0, atol=1e-8)


@pytest.mark.parametrize("lens", LENSES)
def test_the_jacobian_tells_where_a_ray_goes_when_it_turns_a_little(lens: str) -> None:
    camera = camera_of(lens)
    rays, step = camera.unproject(every_pixel()[::997]), np.array([3e-5, -2e-5])
    np.testing.assert_allclose(
        np.einsum("nij,j->ni", camera.jacobian(rays), step), camera.to_pixels(rays + step) - camera.to_pixels(rays), atol=2e-6
    )


@pytest.mark.parametrize("lens", LENSES)
def test_points_fall_on_the_pixels_that_opencv_gives(lens: str) -> None:
    camera = camera_of(lens)
    rays = camera.unproject(every_pixel()[::97])
    points = np.column_stack([rays, np.ones(len(rays))]) * np.linspace(0.02, 0.15, len(rays))[:, None]
    coefficients = np.array(camera.coefficients)
    zero = np.zeros(3)
    if lens == "equidistant":
        expected, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, camera.matrix, coefficients)
    else:
        expected, _ = cv2.projectPoints(points, zero, zero, camera.matrix, coefficients)
    np.testing.assert_allclose(camera.project(points), expected.reshape(-1, 2), rtol=0, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_pixels_have_the_rays_that_opencv_gives(lens: str) -> None:
    camera, pixels = camera_of(lens), every_pixel()[::997]
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-13)
    coefficients = np.array(camera.coefficients)
    if lens == "equidistant":
        expected = cv2.fisheye.undistortPoints(pixels[:, None], camera.matrix, coefficients, criteria=criteria)
    else:
        expected = cv2.undistortPointsIter(pixels[:, None], camera.matrix, coefficients, None, None, criteria)
    np.testing.assert_allclose(camera.unproject(pixels), expected.reshape(-1, 2), rtol=0, atol=1e-9)


@settings(deadline=None, max_examples=60)
@given(st.floats(-0.3, 0.1), st.floats(-0.05, 0.1), st.floats(-0.002, 0.002), st.floats(-0.002, 0.002))
def test_a_lens_called_invertible_has_one_ray_for_each_pixel(k1: float, k2: float, p1: float, p2: float) -> None:
    camera = make_camera("radtan", INTRINSICS, (k1, k2, p1, p2), (640, 480))
    if camera.is_invertible():
        pixels = every_pixel()[::501]
        np.testing.assert_allclose(camera.to_pixels(camera.unproject(pixels)), pixels, atol=1e-6)


@pytest.mark.parametrize("lens", LENSES)
def test_lenses_in_use_are_invertible(lens: str) -> None:
    assert camera_of(lens).is_invertible()


@pytest.mark.parametrize(
    ("model", "coefficients"), [("radtan", (-1.2, 0, 0, 0)), ("radtan", (-0.9, 0.3, 0, 0)), ("equidistant", (-0.9, 0, 0, 0))]
)
def test_a_lens_that_folds_the_image_is_not_invertible(model: str, coefficients: tuple[float, ...]) -> None:
    assert not make_camera(model, INTRINSICS, coefficients, (640, 480)).is_invertible()


def test_a_point_behind_the_camera_has_no_pixel() -> None:
    pixels = camera_of("none").project(np.array([[0.0, 0.0, -0.1], [0.0, 0.0, 0.0], [0.0, 0.0, 0.1]]))
    assert np.isnan(pixels[:2]).all()
    np.testing.assert_allclose(pixels[2], INTRINSICS[2:])


def test_no_points_give_no_pixels() -> None:
    assert camera_of("equidistant").project(np.empty((0, 3))).shape == (0, 2)
    assert camera_of("radtan with k3").unproject(np.empty((0, 2))).shape == (0, 2)
