"""Rejection of false tracks, and of nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from vli_common.arrays import FloatArray
from vli_common.camera import make_camera
from vli_common.geometry import so3_exp
from vli_frontend.outliers import OutlierRejection

F = 360.0
CAMERA = make_camera("none", (F, F, 320.0, 240.0), (), (640, 480))
FISHEYE = make_camera("equidistant", (F, F, 320.0, 240.0), (-0.021, 0.006, -0.002, 0.0004), (640, 480))
ROTATION = so3_exp(np.array([0.01, -0.02, 0.03]))
MOVES = {
    "sideways": np.array([1e-3, 2e-4, 0.0]),
    "forward": np.array([0.0, 0.0, 1e-3]),
    "not at all": np.zeros(3),
    "hardly": np.array([2e-5, 0.0, 0.0]),
}


def views(translation: FloatArray, plane: bool, noise_px: float = 0.1) -> tuple[FloatArray, FloatArray]:
    """Return rays (100, 2) in two frames; points 30 to 40 mm away, or on a plane."""
    rng = np.random.default_rng(4)
    rays = rng.uniform(-0.8, 0.8, (100, 2))
    depth = np.full(100, 0.035) if plane else rng.uniform(0.03, 0.04, 100)
    moved = (np.column_stack([rays, np.ones(100)]) * depth[:, None]) @ ROTATION.T + translation
    return rays, moved[:, :2] / moved[:, 2:] + rng.normal(0, noise_px / F, (100, 2))


@pytest.mark.parametrize("plane", [False, True], ids=["relief", "plane"])
@pytest.mark.parametrize("move", MOVES)
def test_no_good_track_is_rejected_whatever_the_motion_and_the_scene(move: str, plane: bool) -> None:
    assert OutlierRejection(CAMERA, 1.0).inliers(*views(MOVES[move], plane), ROTATION).all()


@pytest.mark.parametrize("known", [True, False], ids=["gyro", "no gyro"])
def test_false_tracks_are_rejected_and_the_others_kept(known: bool) -> None:
    previous, current = views(np.array([2e-3, 5e-4, 3e-4]), plane=False)
    current[:30] += np.random.default_rng(1).choice([-1, 1], (30, 2)) * [4 / F, 14 / F]
    inliers = OutlierRejection(CAMERA, 1.0).inliers(previous, current, ROTATION if known else None)
    assert inliers[30:].mean() > 0.97
    assert inliers[:30].mean() < 0.2


@pytest.mark.parametrize("known", [True, False], ids=["gyro", "no gyro"])
def test_noise_in_pixels_rejects_no_more_at_the_edge_of_a_fisheye_than_in_the_middle(known: bool) -> None:
    rng, kept = np.random.default_rng(7), []
    for _ in range(20):
        pixels = rng.uniform([20, 20], [620, 460], (100, 2))
        rays = FISHEYE.unproject(pixels)
        points = np.column_stack([rays, np.ones(100)]) * rng.uniform(0.03, 0.04, (100, 1))
        moved = FISHEYE.project(points @ ROTATION.T + [0.0, 1e-3, 0.0]) + rng.normal(0, 0.3, (100, 2))
        inliers = OutlierRejection(FISHEYE, 1.0).inliers(rays, FISHEYE.unproject(moved), ROTATION if known else None)
        outer = np.hypot(*(pixels - [320, 240]).T) > 250
        kept.append((inliers[outer].mean(), inliers[~outer].mean()))
    outer_share, inner_share = np.mean(kept, axis=0)
    assert outer_share > (0.98 if known else 0.9)
    assert inner_share > 0.98


def test_the_same_input_gives_the_same_answer_after_a_reset() -> None:
    previous, current = views(MOVES["sideways"], plane=False, noise_px=1.0)
    rejection = OutlierRejection(CAMERA, 1.0)
    first = [rejection.inliers(previous, current, ROTATION) for _ in range(3)]
    rejection.reset()
    again = [rejection.inliers(previous, current, ROTATION) for _ in range(3)]
    np.testing.assert_array_equal(first, again)


def test_a_handful_of_tracks_is_not_judged() -> None:
    previous, current = views(MOVES["sideways"], plane=False)
    assert OutlierRejection(CAMERA, 1.0).inliers(previous[:5], current[:5] + 1.0, ROTATION).all()
