"""A quadratic over many poses becomes one factor of GTSAM, summed up from small ones."""

from __future__ import annotations

import numpy as np
import pytest

from vli_backend.smoother import sum_of_small_factors


@pytest.mark.parametrize("count", range(1, 13))
def test_the_parts_add_up_to_the_quadratic(count):
    rng = np.random.default_rng(count)
    root, gradient = rng.normal(size=(8 * count, 6 * count)), rng.normal(size=6 * count)
    hessian, constant = root.T @ root, 7.5
    whole = sum_of_small_factors(list(range(count)), hessian, gradient, constant)
    np.testing.assert_allclose(whole.information(), hessian, atol=1e-12)
    augmented = whole.augmentedInformation()
    np.testing.assert_allclose(augmented[:-1, -1], gradient, atol=1e-12)
    assert augmented[-1, -1] == pytest.approx(constant)
