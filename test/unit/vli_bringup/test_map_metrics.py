"""Map figures: by definition, on surfaces and clouds whose answer is known, and against exact distances."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from vli_bringup.map_metrics import (
    REACH_M,
    SPACING_M,
    completeness_figures,
    near_triangles,
    nearest_map_points,
    sample_surface,
    surface_distances,
    surface_figures,
)
from vli_common.arrays import FloatArray

SIDE = 0.02


def plate(cells: int = 1, side: float = SIDE) -> FloatArray:
    """Return the square [0, side]² at z = 0, facing up, as triangles (2 cells², 3, 3)."""
    steps = np.linspace(0, side, cells + 1)
    x, y = (a.ravel() for a in np.meshgrid(steps[:-1], steps[:-1]))
    step = side / cells
    corner = [np.stack([x + i * step, y + j * step, 0 * x], axis=1) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))]
    return np.concatenate([np.stack([corner[i] for i in face], axis=1) for face in ((0, 1, 2), (0, 2, 3))])


def points_above(heights: FloatArray, seed: int = 0) -> FloatArray:
    """Return points over the inner part of the plate at these heights."""
    xy = np.random.default_rng(seed).uniform(0.003, SIDE - 0.003, (len(heights), 2))
    return np.column_stack([xy, heights])


@pytest.mark.parametrize("cells", [1, 7, 60])
def test_samples_have_the_density_asked_for_whatever_the_tessellation(cells: int) -> None:
    samples, normals = sample_surface(plate(cells), KDTree(points_above(np.zeros(20_000))))
    inside = ((samples > 0.004) & (samples < SIDE - 0.004))[:, :2].all(axis=1)
    expected = ((SIDE - 0.008) / SPACING_M) ** 2
    assert inside.sum() == pytest.approx(expected, rel=0.02)
    np.testing.assert_array_equal(normals, np.tile([0.0, 0.0, 1.0], (len(samples), 1)))
    # No holes: at random places the nearest sample is hardly ever farther than twice the spacing.
    holes = KDTree(samples).query(points_above(np.zeros(20_000), seed=1))[0]
    assert np.percentile(holes, 99.9) < 2 * SPACING_M


def test_samples_far_from_the_map_are_left_out() -> None:
    spot = np.array([[0.01, 0.01, 0.0]])
    samples, _ = sample_surface(plate(), KDTree(spot))
    assert np.linalg.norm(samples - spot, axis=1).max() <= REACH_M
    assert len(samples) == pytest.approx(np.pi * (REACH_M / SPACING_M) ** 2, rel=0.05)


def test_a_wall_is_sampled_only_where_the_map_is() -> None:
    wall = plate(side=50.0) - np.array([25.0, 25.0, 0.0])  # all of it would be 2.5e11 samples
    points = points_above(np.full(500, 0.0001))
    triangles = near_triangles(wall, KDTree(points), REACH_M)
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1).sum() / 2
    assert area < 2 * SIDE**2
    assert surface_figures(surface_distances(points, wall)).map_point_to_plane_rmse_mm == pytest.approx(0.1, abs=1e-6)


def test_splitting_loses_nothing_of_the_surface_and_turns_nothing_over() -> None:
    rng = np.random.default_rng(6)
    triangles = rng.uniform(-0.02, 0.02, (6, 3, 3))
    everywhere = np.einsum("fsk,fkd->fsd", rng.dirichlet(np.ones(3), (6, 20_000)), triangles).reshape(-1, 3)
    parts = near_triangles(triangles, KDTree(everywhere), REACH_M)
    before, after = (np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]) / 2 for t in (triangles, parts))
    assert len(parts) > 20 * len(triangles)
    assert np.linalg.norm(after, axis=1).sum() == pytest.approx(np.linalg.norm(before, axis=1).sum())
    np.testing.assert_allclose(after.sum(axis=0), before.sum(axis=0), atol=1e-15)


def test_a_known_displacement_is_the_point_to_plane_rmse() -> None:
    figures = surface_figures(surface_distances(points_above(np.full(5000, 0.0003)), plate(9)))
    assert figures.map_point_to_plane_rmse_mm == pytest.approx(0.3, abs=1e-9)
    assert figures.map_point_to_plane_median_mm == pytest.approx(0.3, abs=1e-9)
    # The nearest sample is some 0.05 mm aside: √(0.3² + 0.05²).
    assert figures.map_point_to_point_rmse_mm == pytest.approx(np.hypot(0.3, 0.05), abs=0.005)
    assert (figures.beyond_0_5mm_percent, figures.beyond_1mm_percent) == (0.0, 0.0)


def test_distance_along_the_normal_has_a_sign() -> None:
    heights = np.array([0.0002, -0.0001, 0.0, 0.00005])
    np.testing.assert_allclose(surface_distances(points_above(heights), plate()).to_plane, heights, atol=1e-12)


def test_gaussian_noise_is_measured_as_what_it_is() -> None:
    heights = np.random.default_rng(2).normal(0, 1e-4, 50_000)
    figures = surface_figures(surface_distances(points_above(heights), plate(20)))
    assert figures.map_point_to_plane_rmse_mm == pytest.approx(1e3 * np.sqrt((heights**2).mean()), abs=1e-9)


def test_points_beyond_the_limits_are_counted_and_do_not_enter_the_rmse() -> None:
    heights = np.concatenate([np.full(700, 0.0001), np.full(200, 0.0007), np.full(100, 0.004)])
    figures = surface_figures(surface_distances(points_above(heights), plate(3)))
    assert figures.beyond_0_5mm_percent == pytest.approx(30.0)
    assert figures.beyond_1mm_percent == pytest.approx(10.0)
    assert figures.map_point_to_plane_rmse_mm == pytest.approx(np.sqrt((700 * 0.1**2 + 200 * 0.7**2) / 900), abs=1e-9)


def test_a_curved_surface_agrees_with_the_exact_distance() -> None:
    radius, rng = 0.008, np.random.default_rng(3)
    u, v = np.meshgrid(np.linspace(0, np.pi, 181), np.linspace(0, 0.02, 41), indexing="ij")
    grid = np.stack([radius * np.cos(u), v, radius * np.sin(u)], axis=-1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    pipe = np.concatenate([np.stack(face, axis=2).reshape(-1, 3, 3) for face in ((a, b, c), (a, c, d))])
    angle, along, off = rng.uniform(0.2, 2.9, 20_000), rng.uniform(0.001, 0.019, 20_000), rng.normal(0, 1e-4, 20_000)
    points = np.stack([(radius + off) * np.cos(angle), along, (radius + off) * np.sin(angle)], axis=1)
    figures = surface_figures(surface_distances(points, pipe))
    assert figures.map_point_to_plane_rmse_mm == pytest.approx(1e3 * np.sqrt((off**2).mean()), rel=0.01)


def test_a_map_that_is_nowhere_near_has_no_rmse() -> None:
    figures = surface_figures(surface_distances(points_above(np.full(10, 0.5)), plate()))
    assert figures.map_point_to_plane_rmse_mm is None
    assert (figures.beyond_0_5mm_percent, figures.beyond_1mm_percent) == (100.0, 100.0)


def test_degenerate_triangles_take_no_part() -> None:
    needle = np.zeros((5, 3, 3))
    needle[:, 1, 0] = 0.01
    points = points_above(np.full(500, 0.0002))
    figures = surface_figures(surface_distances(points, np.concatenate([needle, plate(), needle])))
    assert figures.map_point_to_plane_rmse_mm == pytest.approx(0.2, abs=1e-9)
    assert not np.isfinite(surface_distances(points, needle).to_point).any()


def test_completeness_is_the_share_of_seen_points_with_a_map_point_within_half_a_millimetre() -> None:
    seen = np.array([[0.0, 0, 0], [0.00049, 0, 0], [0.00051, 0, 0], [0.3, 0, 0]])
    covered, nearest = nearest_map_points(seen, np.array([[9.0, 9, 9], [0.0, 0, 0]]))
    assert covered.tolist() == [True, True, False, False]
    assert nearest[covered].tolist() == [1, 1]
    assert completeness_figures(covered, None).completeness_percent == 50.0


def test_an_empty_map_covers_nothing() -> None:
    covered, _ = nearest_map_points(np.zeros((7, 3)), np.empty((0, 3)))
    figures = completeness_figures(covered, (np.empty((0, 3), np.uint8), np.empty((0, 3), np.uint8)))
    assert (figures.completeness_percent, figures.colour_rmse) == (0.0, None)
    assert len(surface_distances(np.empty((0, 3)), plate()).to_point) == 0


def test_colour_error_is_a_share_of_full_scale_by_channel() -> None:
    seen = np.random.default_rng(4).integers(40, 200, (1000, 3)).astype(np.uint8)
    figures = completeness_figures(np.ones(1000, np.bool_), (seen, (seen + np.array([3, 0, 51])).astype(np.uint8)))
    by_channel = (figures.colour_rmse_red, figures.colour_rmse_green, figures.colour_rmse_blue)
    assert by_channel == pytest.approx((3 / 255, 0.0, 0.2))
    assert figures.colour_rmse == pytest.approx(np.sqrt(((3 / 255) ** 2 + 0.2**2) / 3))


def test_a_gain_of_a_channel_is_compensated() -> None:
    seen = np.random.default_rng(5).integers(0, 100, (1000, 3)).astype(np.uint8) * 2
    mapped = (seen * [1.0, 0.5, 1.0]).astype(np.uint8)
    figures = completeness_figures(np.ones(1000, np.bool_), (seen, mapped))
    assert figures.colour_rmse is not None
    assert figures.colour_rmse > 0.1
    assert figures.colour_rmse_gain_compensated == pytest.approx(0.0, abs=1e-12)
