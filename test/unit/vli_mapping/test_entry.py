from __future__ import annotations

import numpy as np

from vli_mapping.config import EntryConfig
from vli_mapping.entry import away_from_edges, facing, noisy, supported


def step(depth: float, count: int = 40) -> np.ndarray:
    """Return a stripe 30 mm away that drops by ``depth`` in the middle."""
    x = (np.arange(count) - count / 2) * 8e-5
    return np.stack([x, np.zeros(count), np.where(np.arange(count) < count // 2, 0.03, 0.03 + depth)], axis=1)


SIGMA = np.full(40, 2e-5)


def test_points_beside_an_occlusion_edge_are_doubted() -> None:
    keep = away_from_edges(step(3e-3), SIGMA, EntryConfig(edge_trim=2))
    assert np.flatnonzero(~keep).tolist() == [18, 19, 20, 21]


def test_a_slope_that_a_camera_can_see_and_noise_are_no_edges() -> None:
    steep = step(0.0)
    steep[:, 2] += np.tan(np.radians(75)) * steep[:, 0]
    assert away_from_edges(steep, SIGMA, EntryConfig()).all()
    noisy_stripe = step(0.0) + [0, 0, 1] * np.random.default_rng(0).normal(size=(40, 1)) * 2e-5
    assert away_from_edges(noisy_stripe, SIGMA, EntryConfig()).all()


def test_the_ends_of_a_stripe_are_no_edges_but_a_gap_is() -> None:
    stripe = np.delete(step(0.0), slice(15, 25), axis=0)
    keep = away_from_edges(stripe, SIGMA[:30], EntryConfig(edge_trim=1))
    assert np.flatnonzero(~keep).tolist() == [14, 15]


def test_a_short_piece_between_two_edges_is_doubted_whole() -> None:
    stripe = step(0.0)
    stripe[18:21, 2] += 4e-3
    keep = away_from_edges(stripe, SIGMA, EntryConfig(edge_trim=1, min_segment=5))
    assert np.flatnonzero(~keep).tolist() == [17, 18, 19, 20, 21]


def test_a_ghost_that_one_scan_alone_has_seen_is_not_supported() -> None:
    stripe = step(0.0)
    stripe[5, 2] += 5e-3
    beside = step(0.0) + np.array([0, 5e-4, 0])
    assert np.flatnonzero(~supported(stripe, beside, 1e-3)).tolist() == [5]
    assert not supported(stripe, np.empty((0, 3)), 1e-3).any()


def test_points_seen_at_a_grazing_angle_or_without_a_normal_do_not_face_the_camera() -> None:
    points = np.array([[0, 0, 0.03]] * 4)
    angles = np.radians([0, 79, 81, 0])
    normals = np.stack([np.sin(angles), np.zeros(4), -np.cos(angles)], axis=1).astype(np.float32)
    normals[3] = 0
    assert facing(points, normals, 80.0).tolist() == [True, True, False, False]


def test_blur_is_told_from_distance() -> None:
    points = np.array([[0, 0, z] for z in (0.03, 0.03, 0.03, 0.06, 0.06)])
    sigma = np.array([1.0, 1.1, 3.0, 4.0, 12.0]) * 2e-5
    assert noisy(points, sigma, 2.0).tolist() == [False, False, True, False, True]
