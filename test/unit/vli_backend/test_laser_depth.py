"""Depth of features from the stripes around them."""

from __future__ import annotations

import numpy as np
import pytest

from vli_backend.laser_depth import laser_depths
from vli_common.arrays import FloatArray

FOCAL = 360.0


def _stripes(offsets_px: list[float], normal: FloatArray, distance: float, noise: float = 0.0) -> FloatArray:
    """Points of a plane n · X = d on stripes that are image rows at the given offsets from the centre."""
    x = np.linspace(-0.3, 0.3, 400)
    rays = np.concatenate([np.stack([x, np.full_like(x, y / FOCAL), np.ones_like(x)], axis=1) for y in offsets_px])
    points = rays * (distance / (rays @ normal))[:, None]
    return points * (1 + np.random.default_rng(0).normal(scale=noise, size=len(points)) / points[:, 2])[:, None]


def _depths(features_px: list[tuple[float, float]], points: FloatArray, sigma: float = 5e-5):  # type: ignore[no-untyped-def]
    return laser_depths(np.array(features_px) / FOCAL, points, np.full(len(points), sigma), FOCAL, 12.0, 8, 1.2e-4)


def test_a_tilted_plane_gives_the_exact_depth_between_two_stripes() -> None:
    normal = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    found = _depths([(20.0, 3.0), (-40.0, 6.0)], _stripes([0.0, 9.0], normal, 0.03))
    rays = np.array([[20.0, 3.0, FOCAL], [-40.0, 6.0, FOCAL]]) / FOCAL
    np.testing.assert_allclose(1 / found.inverse_depth, 0.03 / (rays @ normal), atol=2e-6)
    np.testing.assert_allclose(found.stripe_px, 3.0, atol=0.3)


def test_sigma_grows_with_the_distance_from_a_single_stripe() -> None:
    found = _depths([(0.0, 1.0), (0.0, 10.0)], _stripes([0.0], np.array([0, 0, 1.0]), 0.03))
    assert found.sigma[1] > 3 * found.sigma[0]


def test_a_feature_far_from_every_stripe_has_no_depth() -> None:
    found = _depths([(0.0, 13.0)], _stripes([0.0], np.array([0, 0, 1.0]), 0.03))
    assert np.isnan(found.inverse_depth[0])
    assert np.isinf(found.stripe_px[0])


def test_a_depth_edge_gives_no_depth() -> None:
    points = _stripes([0.0, 5.0], np.array([0, 0, 1.0]), 0.03)
    points[points[:, 0] > 0] *= 1.05
    found = _depths([(0.0, 2.0)], points)
    assert np.isnan(found.inverse_depth[0])


def test_the_stated_sigma_is_the_spread_of_the_depth() -> None:
    errors = []
    normal = np.array([0, 0, 1.0])
    rng = np.random.default_rng(3)
    clean = _stripes([-6.0, 0.0, 6.0], normal, 0.03)
    for _ in range(60):
        points = clean * (1 + rng.normal(scale=5e-5, size=len(clean)) / clean[:, 2])[:, None]
        found = _depths([(0.0, 2.0)], points)
        errors.append((found.inverse_depth[0] - 1 / 0.03) / found.sigma[0])
    assert 0.7 < float(np.std(errors)) < 1.3


def test_no_points_give_no_depths() -> None:
    assert np.isnan(_depths([(0.0, 0.0)], np.empty((0, 3))).inverse_depth).all()


@pytest.mark.parametrize("count", [3, 7])
def test_too_few_points_give_no_depth(count: int) -> None:
    points = _stripes([0.0], np.array([0, 0, 1.0]), 0.03)
    nearest = np.argsort(np.abs(points[:, 0]))[:count]
    assert np.isnan(_depths([(0.0, 1.0)], points[nearest]).inverse_depth[0])
