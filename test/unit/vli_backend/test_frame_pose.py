"""Pose of one frame from landmarks and a prediction."""

from __future__ import annotations

import numpy as np
import pytest

from vli_backend.frame_pose import pose_by_features, solve_frame_pose
from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, pose, so3_exp, so3_log, transform

SIGMA = 0.3 / 360
WHITE = np.tile(np.eye(2) / SIGMA, (60, 1, 1))
WEAK = np.eye(6) * 1e-3


def _scene(count: int = 60, seed: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    T = pose(so3_exp(np.array([0.1, -0.2, 0.3])), np.array([0.01, 0.02, -0.005]))
    local = np.stack(
        [rng.uniform(-0.02, 0.02, count), rng.uniform(-0.015, 0.015, count), rng.uniform(0.025, 0.04, count)], axis=1
    )
    return T, transform(T, local), local[:, :2] / local[:, 2:]


def _error(found: FloatArray, truth: FloatArray) -> tuple[float, float]:
    return float(np.linalg.norm(found[:3, 3] - truth[:3, 3])), float(np.linalg.norm(so3_log(found[:3, :3].T @ truth[:3, :3])))


def test_exact_observations_give_the_exact_pose() -> None:
    T, points, rays = _scene()
    start = T @ pose(so3_exp(np.array([0.02, 0.03, -0.02])), np.array([0.002, -0.001, 0.002]))
    found = solve_frame_pose(start, WEAK * 1e-6, points, np.zeros_like(points), rays, WHITE, 10.0, 20)
    assert max(_error(found.T_map_camera, T)) < 1e-7
    assert found.inliers == len(points)


def test_a_third_of_wrong_matches_hardly_moves_the_pose() -> None:
    T, points, rays = _scene()
    rng = np.random.default_rng(1)
    rays = rays + rng.normal(scale=SIGMA, size=rays.shape)
    rays[::3] += rng.uniform(0.02, 0.05, size=rays[::3].shape)
    found = solve_frame_pose(T, WEAK, points, np.zeros_like(points), rays, WHITE, 1.0, 20)
    metres, radians = _error(found.T_map_camera, T)
    assert metres < 3e-5
    assert radians < 2e-3
    assert found.inliers <= 40


def test_the_information_is_that_of_the_error() -> None:
    T, points, rays = _scene()
    rng = np.random.default_rng(2)
    normalised = []
    for _ in range(200):
        noisy = rays + rng.normal(scale=SIGMA, size=rays.shape)
        found = solve_frame_pose(T, WEAK, points, np.zeros_like(points), noisy, WHITE, 1e3)
        step = inverse(T) @ found.T_map_camera
        error = np.concatenate([so3_log(step[:3, :3]), step[:3, 3]])
        normalised.append(error @ found.information @ error)
    assert np.mean(normalised) == pytest.approx(6.0, rel=0.2)


def test_a_landmark_of_unknown_depth_does_not_pull_along_its_ray() -> None:
    T, points, rays = _scene()
    anchor = T[:3, 3] + np.array([0.003, 0.0, 0.0])
    wrong = points + 0.2 * (points - anchor)
    spread = 0.3 * (points - anchor)
    half = len(points) // 2
    mixed = np.concatenate([points[:half], wrong[half:]])
    known = np.concatenate([np.zeros_like(points[:half]), spread[half:]])
    args = (rays, WHITE, 1e3)
    careful = _error(solve_frame_pose(T, WEAK, mixed, known, *args).T_map_camera, T)
    trusting = _error(solve_frame_pose(T, WEAK, mixed, np.zeros_like(points), *args).T_map_camera, T)
    assert careful[0] < 1e-4 < trusting[0]


def test_without_landmarks_the_prediction_stands() -> None:
    T = _scene()[0]
    found = solve_frame_pose(T, np.eye(6), np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 2)), np.empty((0, 2, 2)), 1.0)
    np.testing.assert_allclose(found.T_map_camera, T, atol=1e-12)
    assert found.inliers == 0


def test_features_alone_find_a_pose_that_nothing_predicts_in_spite_of_wrong_matches() -> None:
    T, points, rays = _scene()
    rng = np.random.default_rng(3)
    rays = rays + rng.normal(scale=SIGMA, size=rays.shape)
    rays[::2] += rng.uniform(0.05, 0.3, size=rays[::2].shape)
    found = pose_by_features(points, rays, 360.0)
    assert found is not None
    metres, radians = _error(found, T)
    assert metres < 1e-3
    assert radians < 0.03


@pytest.mark.parametrize("right", [0, 8])
def test_features_that_do_not_agree_tell_no_pose(right) -> None:
    _, points, rays = _scene()
    rays[right:] = np.random.default_rng(4).uniform(-0.6, 0.6, size=rays[right:].shape)
    assert pose_by_features(points, rays, 360.0) is None
    assert pose_by_features(points[:8], rays[:8], 360.0) is None
