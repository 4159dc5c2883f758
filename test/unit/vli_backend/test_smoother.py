"""The smoother where nothing determines a keyframe."""

from __future__ import annotations

import numpy as np
import pytest

from vli_backend.condense import Quadratic
from vli_backend.smoother import GtsamSmoother, KeyframeState, SmootherError, StatePrior
from vli_common.arrays import FloatArray
from vli_common.geometry import pose

PRIOR = StatePrior(np.full(3, 1e-4), 1e-6, 1e-3, 0.02, 0.2)


def _state(x: float) -> KeyframeState:
    return KeyframeState(pose(np.eye(3), np.array([x, 0.0, 0.0])), np.zeros(3), np.zeros(3), np.zeros(3))


def _blind(T_map_imu: FloatArray) -> Quadratic:
    size = 6 * len(T_map_imu)
    return Quadratic(np.zeros((size, size)), np.zeros(size), 0.0)


def _undetermined() -> GtsamSmoother:
    """Return a window whose newest keyframe has neither IMU nor features."""
    smoother = GtsamSmoother(4)
    smoother.start(_state(0.0), PRIOR)
    smoother.add_keyframe(_state(0.01), None, 0.3)
    smoother.solve(_blind, 3)
    return smoother


def test_a_keyframe_that_nothing_determines_has_no_covariance() -> None:
    with pytest.raises(SmootherError, match="no covariance"):
        _undetermined().newest_covariance()


def test_held_weakly_it_stays_where_it_was_guessed_and_the_window_keeps_what_it_knew() -> None:
    smoother = _undetermined()
    smoother.hold_newest()
    smoother.solve(_blind, 3)
    np.testing.assert_allclose([state.T_map_imu[0, 3] for state in smoother.states()], [0.0, 0.01], atol=1e-9)
    np.testing.assert_allclose(np.sqrt(np.diag(smoother.newest_covariance())), np.repeat([0.1, 0.01], 3), rtol=1e-6)


def test_after_a_failure_a_keyframe_is_not_added_twice() -> None:
    smoother = GtsamSmoother(4)
    smoother.start(_state(0.0), PRIOR)
    smoother.add_keyframe(_state(0.01), None, 0.3)

    def broken(T_map_imu: FloatArray) -> Quadratic:
        size = 6 * len(T_map_imu)
        return Quadratic(np.full((size, size), np.nan), np.zeros(size), 0.0)

    with pytest.raises(SmootherError):
        smoother.solve(broken, 3)
    smoother.hold_newest()
    smoother.solve(_blind, 3)
    assert len(smoother.states()) == 2
    np.testing.assert_allclose(smoother.states()[1].T_map_imu[:3, 3], [0.01, 0.0, 0.0], atol=1e-6)
