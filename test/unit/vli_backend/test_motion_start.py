"""Structure from motion at the start: its scale is the laser's, however far off it is at first."""

from __future__ import annotations

import numpy as np
import pytest

from vli_backend.landmarks import LandmarkTable
from vli_backend.motion_start import _to_scale
from vli_common.geometry import inverse, pose, so3_exp, transform


@pytest.mark.parametrize("factor", [0.6, 1.0, 1.7])
def test_landmarks_and_poses_are_brought_to_the_scale_that_most_depths_tell(factor: float) -> None:
    rng = np.random.default_rng(1)
    true_poses = np.stack([pose(so3_exp(0.02 * k * np.ones(3)), np.array([0.003 * k, 0.001 * k, 0.0])) for k in range(3)])
    points = np.column_stack([rng.uniform(-0.01, 0.01, (40, 2)), rng.uniform(0.03, 0.045, 40)])
    table = LandmarkTable(3)
    for T in true_poses:
        local = transform(inverse(T), points)
        rays = local[:, :2] / local[:, 2:]
        table.add_keyframe(np.arange(40), rays, np.tile(1e3 * np.eye(2), (40, 1, 1)), np.zeros(40, np.bool_), 30.0)
    table.arrays.rho = factor / points[:, 2]
    depth = 1.0 / transform(inverse(true_poses[1]), points)[:9, 2]
    # Two are on an edge, and wrong.
    depth[:2] *= 1.4
    table.set_depths(1, np.arange(9), depth, np.full(9, 0.1), np.ones(9), primary_only=True)
    wrong = np.stack([pose(T[:3, :3], T[:3, 3] / factor) for T in true_poses])
    np.testing.assert_allclose(_to_scale(table, wrong), true_poses, atol=1e-9)
    np.testing.assert_allclose(table.arrays.rho, 1.0 / points[:, 2], rtol=1e-6)
