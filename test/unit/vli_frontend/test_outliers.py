"""Rejection of false tracks, and of nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from vli_common.arrays import FloatArray
from vli_common.geometry import so3_exp
from vli_frontend.outliers import OutlierRejection

F = 360.0
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
    assert OutlierRejection(1 / F).inliers(*views(MOVES[move], plane), ROTATION).all()


@pytest.mark.parametrize("known", [True, False], ids=["gyro", "no gyro"])
def test_false_tracks_are_rejected_and_the_others_kept(known: bool) -> None:
    previous, current = views(np.array([2e-3, 5e-4, 3e-4]), plane=False)
    current[:30] += np.random.default_rng(1).choice([-1, 1], (30, 2)) * [4 / F, 14 / F]
    inliers = OutlierRejection(1 / F).inliers(previous, current, ROTATION if known else None)
    assert inliers[30:].mean() > 0.97
    assert inliers[:30].mean() < 0.2


def test_the_same_input_gives_the_same_answer_after_a_reset() -> None:
    previous, current = views(MOVES["sideways"], plane=False, noise_px=1.0)
    rejection = OutlierRejection(1 / F)
    first = [rejection.inliers(previous, current, ROTATION) for _ in range(3)]
    rejection.reset()
    again = [rejection.inliers(previous, current, ROTATION) for _ in range(3)]
    np.testing.assert_array_equal(first, again)


def test_a_handful_of_tracks_is_not_judged() -> None:
    previous, current = views(MOVES["sideways"], plane=False)
    assert OutlierRejection(1 / F).inliers(previous[:5], current[:5] + 1.0, ROTATION).all()
