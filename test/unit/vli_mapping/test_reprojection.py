"""Matches of an image with the map are judged in pixels, whatever the lens."""

from __future__ import annotations

import numpy as np
import pytest

from vli_common.arrays import FloatArray
from vli_common.camera import CameraModel, make_camera
from vli_common.geometry import inverse, pose, so3_exp, so3_log, transform
from vli_mapping.features import ImageFeatures, describe_image
from vli_mapping.keyframe import MapKeyframe
from vli_mapping.place_recognition import Evidence, PlaceIndex
from vli_mapping.reprojection import TOLERANCE_PX, Matches, errors_px, moved, normal_equations, resect

LENSES = {
    "fisheye": make_camera("equidistant", (360.0, 360.0, 320.0, 240.0), (-0.021, 0.006, -0.002, 0.0004), (640, 480)),
    "wide": make_camera("radtan", (330.0, 330.0, 320.0, 240.0), (-0.28, 0.07, 0.0, 0.0), (640, 480)),
    "none": make_camera("none", (500.0, 500.0, 320.0, 240.0), (), (640, 480)),
}
SCALE = 2.0
"""Raw pixels per pixel of the corners' image."""
T_MAP_CAMERA = pose(so3_exp(np.array([3.0, 0.1, -0.2])), np.array([0.02, -0.01, 0.035]))


def matches(
    camera: CameraModel, count: int = 150, noise_px: float = 0.4, wrong: float = 0.0, seed: int = 1
) -> tuple[Matches, FloatArray]:
    """Return matches all over an image, their corners off by noise, and how far off the axis each is in raw pixels (N,)."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([10, 10], [630, 470], (count, 2))
    rays = camera.unproject(pixels)
    local = np.column_stack([rays, np.ones(count)]) * rng.uniform(0.03, 0.036, (count, 1))
    seen = pixels + SCALE * noise_px * rng.normal(size=(count, 2))
    stray = rng.random(count) < wrong
    seen[stray] = rng.uniform([10, 10], [630, 470], (stray.sum(), 2))
    found = camera.unproject(seen)
    return Matches(transform(T_MAP_CAMERA, local), found, camera.jacobian(found) / SCALE), np.hypot(*(pixels - [320, 240]).T)


@pytest.mark.parametrize("lens", LENSES)
def test_the_error_of_a_match_is_that_in_the_image(lens: str) -> None:
    camera = LENSES[lens]
    found, _ = matches(camera)
    local = transform(inverse(T_MAP_CAMERA), found.points)
    exact = (camera.to_pixels(found.rays) - camera.project(local)) / SCALE
    np.testing.assert_allclose(errors_px(found, local), exact, atol=0.06)


def test_a_point_behind_the_camera_is_no_match() -> None:
    found, _ = matches(LENSES["none"])
    local = transform(inverse(T_MAP_CAMERA), found.points) * [1, 1, -1]
    assert np.isinf(errors_px(found, local)).all()


@pytest.mark.parametrize("lens", LENSES)
def test_noise_costs_no_more_support_at_the_edge_of_a_lens_than_in_the_middle(lens: str) -> None:
    camera, rng, count = LENSES[lens], np.random.default_rng(3), 2000
    pixels = rng.uniform([2, 2], [638, 478], (count, 2))
    points = np.column_stack([camera.unproject(pixels), np.ones(count)]) * rng.uniform(0.03, 0.036, (count, 1))
    descriptors, thumbnail = rng.integers(0, 256, (count, 32), np.uint8), np.zeros((120, 160), np.uint8)
    index = PlaceIndex([MapKeyframe(np.eye(4), 0.033, points, descriptors, thumbnail)], camera)
    features = ImageFeatures(pixels + SCALE * rng.normal(size=(count, 2)), descriptors, thumbnail, SCALE)
    evidence, hypotheses = index.match(0, features, np.eye(4))
    np.testing.assert_allclose(hypotheses[0], np.eye(4), atol=5e-3)
    radius = np.hypot(*(pixels[evidence.features] - [320, 240]).T)
    expected = 1 - np.exp(-(TOLERANCE_PX**2) / 2)
    for where in (radius < 120, radius > 280):
        part = Evidence(0, np.eye(4), evidence.matches.at(where), evidence.features[where])
        assert index.support([part], np.eye(4)) / where.sum() == pytest.approx(expected, abs=0.07)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("wrong", [0.0, 0.6])
def test_a_pose_is_found_among_wrong_matches(lens: str, wrong: float) -> None:
    found, _ = matches(LENSES[lens], wrong=wrong)
    T = resect(found)
    assert T is not None
    assert np.linalg.norm(T[:3, 3] - T_MAP_CAMERA[:3, 3]) < 1.5e-4
    assert np.linalg.norm(so3_log(T[:3, :3].T @ T_MAP_CAMERA[:3, :3])) < 5e-3


def test_a_pose_is_found_by_what_only_the_edge_of_a_fisheye_shows() -> None:
    """Noise of 1.2 px there is 4.5 times as wide on the plane of rays: by one limit for all rays most would not count."""
    found, radius = matches(LENSES["fisheye"], 1500, noise_px=0.6, wrong=0.5)
    T = resect(found.at(radius > 300))
    assert T is not None
    assert np.linalg.norm(T[:3, 3] - T_MAP_CAMERA[:3, 3]) < 3e-4


def test_matches_that_agree_on_nothing_or_are_few_give_no_pose() -> None:
    found, _ = matches(LENSES["none"], 60, wrong=1.0)
    assert resect(found) is None
    few, _ = matches(LENSES["none"], 7)
    assert resect(few) is None


def test_the_same_matches_give_the_same_pose() -> None:
    found, _ = matches(LENSES["fisheye"], wrong=0.5)
    np.testing.assert_array_equal(resect(found), resect(found))


def test_normal_equations_are_those_of_the_errors_in_pixels() -> None:
    found, _ = matches(LENSES["fisheye"], noise_px=0.0)
    views, centre = np.broadcast_to(T_MAP_CAMERA, (len(found), 4, 4)), found.points.mean(axis=0)
    off = pose(so3_exp(np.array([0.002, -0.003, 0.004])), np.array([1e-4, -2e-4, 1e-4]))
    T = np.eye(4)
    for _ in range(6):
        T = moved(T, *normal_equations(found, views, T, centre), centre)
    np.testing.assert_allclose(T, np.eye(4), atol=1e-9)
    once = moved(off, *normal_equations(found, views, off, centre), centre)
    before, after = (np.abs(transform(T, found.points) - found.points).max() for T in (off, once))
    assert after < 0.2 * before


def test_corners_beyond_the_horizon_of_a_fisheye_are_left_out() -> None:
    camera = make_camera("equidistant", (180.0, 180.0, 320.0, 240.0), (0.0, 0.0, 0.0, 0.0), (640, 480))
    pixels = np.array([[320.0, 240.0], [610.0, 240.0], [100.0, 100.0]])
    features = ImageFeatures(pixels, np.zeros((3, 32), np.uint8), np.zeros((120, 160), np.uint8), SCALE)
    left, rays = features.with_rays(camera)
    np.testing.assert_array_equal(left.pixels, pixels[[0, 2]])
    assert np.isfinite(rays).all()


@pytest.mark.parametrize(("width", "scale"), [(320, 1.0), (640, 2.0), (1280, 4.0)])
def test_corners_say_at_which_scale_they_were_found(width: int, scale: float) -> None:
    assert describe_image(np.zeros((width * 3 // 4, width), np.uint8)).scale == scale
