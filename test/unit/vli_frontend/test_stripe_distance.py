"""Distance of features to the laser stripe."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from vli_common.types import LaserScan
from vli_frontend.stripe_distance import StripeDistance

MS = 1_000_000
RNG = np.random.default_rng(0)
FEATURES = RNG.uniform(0, 640, (50, 2))


def scan(stamp_ns: int, pixels: np.ndarray) -> LaserScan:
    n = len(pixels)
    return LaserScan(stamp_ns, np.zeros((n, 3)), pixels, np.ones(n), np.ones(n))


def test_the_distance_is_that_to_the_nearest_point_of_all_adjacent_stripes() -> None:
    stripes = StripeDistance(25 * MS)
    before, after = RNG.uniform(0, 640, (300, 2)), RNG.uniform(0, 640, (200, 2))
    stripes.add(scan(83 * MS, before))
    stripes.add(scan(117 * MS, after))
    expected = cdist(FEATURES, np.concatenate([before, after])).min(axis=1)
    np.testing.assert_allclose(stripes.measure(100 * MS, FEATURES), expected)


def test_a_stripe_farther_in_time_does_not_count() -> None:
    stripes = StripeDistance(25 * MS)
    stripes.add(scan(70 * MS, FEATURES))
    assert np.isinf(stripes.measure(100 * MS, FEATURES)).all()


def test_an_empty_stripe_leaves_the_features_without() -> None:
    stripes = StripeDistance(25 * MS)
    stripes.add(scan(90 * MS, np.empty((0, 2))))
    assert np.isinf(stripes.measure(100 * MS, FEATURES)).all()


def test_cleared_stripes_are_forgotten() -> None:
    stripes = StripeDistance(25 * MS)
    stripes.add(scan(90 * MS, FEATURES))
    stripes.clear()
    assert np.isinf(stripes.measure(100 * MS, FEATURES)).all()
