"""A quadratic over many poses becomes one factor of GTSAM, summed up from small ones."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from vli_backend.smoother import _cover, _hessian


@pytest.mark.parametrize("count", range(1, 13))
def test_every_pair_of_poses_is_carried_once(count):
    carried = np.zeros((count, count))
    for poses, carries in _cover(count):
        assert len(poses) <= 3
        carried[np.ix_(poses, poses)] += carries[::6, ::6]
    np.testing.assert_array_equal(carried, np.ones((count, count)))


@pytest.mark.parametrize("count", [1, 2, 3, 7, 11])
def test_the_parts_add_up_to_the_quadratic(count):
    rng = np.random.default_rng(count)
    root, gradient = rng.normal(size=(8 * count, 6 * count)), rng.normal(size=6 * count)
    hessian, constant = root.T @ root, 7.5
    graph = gtsam.GaussianFactorGraph()
    for index, (poses, carries) in enumerate(_cover(count)):
        rows = np.concatenate([np.arange(6 * i, 6 * i + 6) for i in poses])
        part = hessian[np.ix_(rows, rows)] * carries
        graph.push_back(_hessian(list(poses), part, gradient[rows] * carries.diagonal(), constant if index == 0 else 0.0))
    whole = gtsam.HessianFactor(graph)
    np.testing.assert_allclose(whole.information(), hessian, atol=1e-12)
    augmented = whole.augmentedInformation()
    np.testing.assert_allclose(augmented[:-1, -1], gradient, atol=1e-12)
    assert augmented[-1, -1] == pytest.approx(constant)
