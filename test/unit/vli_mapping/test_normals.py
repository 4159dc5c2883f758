from __future__ import annotations

import numpy as np
import pytest

from vli_mapping.normals import fit_plane, smallest_eigenvector, stripe_normals


def three_stripes(slope: float, spacing: float = 4e-4) -> tuple[np.ndarray, np.ndarray]:
    """Return a stripe and the two beside it, 30 mm in front of the camera, on a plane that recedes with y."""
    x = np.arange(-5e-3, 5e-3, 8e-5)
    rows = [np.stack([x, np.full_like(x, y), 0.03 + slope * np.full_like(x, y)], axis=1) for y in (0.0, -spacing, spacing)]
    return rows[0], np.concatenate(rows[1:])


@pytest.mark.parametrize("slope", [0.0, 0.5, -1.5])
def test_a_plane_gives_its_normal_towards_the_camera(slope: float) -> None:
    points, beside = three_stripes(slope)
    normals, planarity = stripe_normals(points, beside, 8e-4, 0.75)
    expected = np.array([0.0, slope, -1.0]) / np.hypot(slope, 1.0)
    np.testing.assert_allclose(normals, np.broadcast_to(expected, normals.shape), atol=1e-5)
    assert planarity.min() > 0.999


def test_a_single_stripe_gives_no_normal() -> None:
    points, _ = three_stripes(0.0)
    points = points + np.random.default_rng(0).normal(size=points.shape) * 2e-5
    normals, _ = stripe_normals(points, np.empty((0, 3)), 8e-4, 0.75)
    assert not normals.any()


def test_clutter_gives_no_normal() -> None:
    rng = np.random.default_rng(0)
    centre = np.array([0, 0, 0.03])
    points, beside = centre + rng.uniform(-1e-3, 1e-3, (200, 3)), centre + rng.uniform(-1e-3, 1e-3, (400, 3))
    normals, planarity = stripe_normals(points, beside, 8e-4, 0.75)
    assert (~normals.any(axis=1)).mean() > 0.9
    assert planarity.mean() < 0.5


def test_noise_of_a_stripe_tilts_normals_by_a_few_degrees_only() -> None:
    points, beside = three_stripes(0.3)
    rng = np.random.default_rng(0)
    points, beside = points + rng.normal(size=points.shape) * 2e-5, beside + rng.normal(size=beside.shape) * 2e-5
    normals, _ = stripe_normals(points, beside, 8e-4, 0.75)
    known = normals.any(axis=1)
    cosine = normals[known] @ (np.array([0.0, 0.3, -1.0]) / np.hypot(0.3, 1.0))
    assert known.mean() > 0.95
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 4


def test_the_closed_form_agrees_with_numpy() -> None:
    rng = np.random.default_rng(3)
    vector = np.empty(3)
    for scales in ([1, 1, 1e-3], [1, 1e-2, 1e-4], [1e-6, 1e-6, 1e-9], [1, 1, 1]):
        a = rng.normal(size=(3, 3)) * scales
        m = a.T @ a
        found = smallest_eigenvector(m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2], vector)
        values, vectors = np.linalg.eigh(m)
        # Of the closed form: a share of the largest eigenvalue, not of each.
        assert found == pytest.approx(values, abs=1e-8 * values[2])
        assert abs(vector @ vectors[:, 0]) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("points", [np.zeros((5, 3)), np.zeros((2, 3)), np.outer(np.arange(6), [1e-4, 0, 0])])
def test_points_that_span_no_plane_have_no_planarity(points: np.ndarray) -> None:
    plane = np.empty(8)
    fit_plane(points, np.arange(len(points)), points[0], plane)
    assert plane[6] < 1e-6
    assert np.isfinite(plane).all()


def test_a_fitted_plane_far_from_the_origin_is_as_exact() -> None:
    rng = np.random.default_rng(0)
    offset = np.array([3.0, -2.0, 1.0])
    points = np.stack([rng.uniform(-1e-3, 1e-3, 40), rng.uniform(-1e-3, 1e-3, 40), np.zeros(40)], axis=1) + offset
    plane = np.empty(8)
    fit_plane(points, np.arange(40), points[0], plane)
    assert abs(plane[5]) == pytest.approx(1.0, abs=1e-9)
    assert plane[2] == pytest.approx(1.0, abs=1e-12)
    assert plane[7] < 1e-9
