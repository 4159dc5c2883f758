"""The plane of the stripes: total least squares, robust over points, and over images."""

from __future__ import annotations

import numpy as np
from laser_sets import PLANE

from vli_calibration.plane_fit import ImagePoints, agreeing_images, disagreements, fit_plane, fit_plane_robust, spread
from vli_common.arrays import FloatArray

SIGMA = 3e-5


def line(rng: np.random.Generator, depth: float, off: FloatArray | float = 0.0) -> FloatArray:
    """Return a stripe (100, 3) on the plane at a depth, a distance off it."""
    x = np.linspace(-0.02, 0.02, 100)
    z = depth + rng.uniform(-0.3, 0.3) * x
    y = -(PLANE.normal[0] * x + PLANE.normal[2] * z + PLANE.d) / PLANE.normal[1]
    return np.column_stack([x, y, z]) + np.outer(SIGMA * rng.normal(size=100) + off, PLANE.normal)


def images(count: int = 12, seed: int = 0) -> list[ImagePoints]:
    rng = np.random.default_rng(seed)
    return [ImagePoints(f"im{k}", line(rng, z), np.full(100, SIGMA)) for k, z in enumerate(np.linspace(0.04, 0.11, count))]


def test_the_plane_comes_back_with_its_sign() -> None:
    points = np.concatenate([image.points for image in images()])
    plane = fit_plane(points)
    np.testing.assert_allclose(plane.vector, PLANE.vector, atol=2e-4)
    assert plane.d > 0


def test_a_fifth_of_wild_points_does_not_move_it() -> None:
    points = np.concatenate([image.points for image in images()])
    points[::5] += np.random.default_rng(1).uniform(1e-3, 8e-3, (len(points[::5]), 1)) * PLANE.normal
    assert np.abs(fit_plane(points).vector - PLANE.vector).max() > 5e-4
    np.testing.assert_allclose(fit_plane_robust(points).vector, PLANE.vector, atol=2e-4)


def test_a_bad_far_image_is_named_and_left_out() -> None:
    set_of_images = images()
    bad = line(np.random.default_rng(2), 0.15, 6e-4)
    set_of_images.append(ImagePoints("far", bad, np.full(100, SIGMA)))
    assert max(disagreements(set_of_images), key=lambda item: item.size).name == "far"
    kept, out = agreeing_images(set_of_images, 4)
    assert [item.name for item in out] == ["far"]
    assert len(kept) == 12
    assert 5e-4 < out[0].distance_m < 8e-4


def test_images_that_agree_all_stay() -> None:
    kept, out = agreeing_images(images(), 4)
    assert len(kept) == 12
    assert out == []


def test_stripes_beside_the_board_have_no_vote_however_many() -> None:
    rng = np.random.default_rng(3)
    on_table = [ImagePoints(f"table{k}", line(rng, z, 8e-4), np.full(100, SIGMA), sure=False)
                for k, z in enumerate(np.linspace(0.05, 0.12, 9))]  # fmt: skip
    kept, out = agreeing_images([*images(8), *on_table], 4)
    assert {image.name for image in kept} == {f"im{k}" for k in range(8)}
    assert len(out) == 9


def test_the_spread_tells_a_line_from_a_plane() -> None:
    rng = np.random.default_rng(4)
    one_line = [ImagePoints(str(k), line(rng, 0.05) * [1, 0, 0] + [0, 0, 0.05], np.full(100, SIGMA)) for k in range(5)]
    assert spread(one_line)[1] < 1e-4
    assert spread(images())[1] > 5e-3
