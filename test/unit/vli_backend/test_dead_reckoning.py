"""Where the scanner may be while nothing tracks."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from vli_backend.dead_reckoning import DeadReckoning
from vli_backend.initialisation import GRAVITY
from vli_backend.smoother import KeyframeState
from vli_common.types import FrontEndOutput, Preintegration, Tracks

BEGIN = 1_000_000_000
MS = 1_000_000
NOTHING = np.zeros(3)
MOVING = KeyframeState(np.eye(4), np.array([0.02, 0.0, 0.0]), NOTHING, NOTHING)


def _measured(from_ns: int, to_ns: int, gap_sigma: float = 0.0) -> Preintegration:
    """Return the IMU of a scanner that goes on as it did; with noise on the gyroscope as of a gap, rad/s/√Hz."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY)
    params.setGyroscopeCovariance(np.eye(3) * max(gap_sigma, 1e-4) ** 2)
    params.setAccelerometerCovariance(np.eye(3) * 1e-4)
    found = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias())
    for _ in range((to_ns - from_ns) // (5 * MS)):
        found.integrateMeasurement(np.array([0.0, 0.0, GRAVITY]), NOTHING, 5e-3)
    return Preintegration(to_ns, from_ns, found, 1e4 if gap_sigma else 1.0, 0)


def _frame(stamp_ns: int, measured: Preintegration | None, keyframe: bool = True) -> FrontEndOutput:
    none, pairs = np.empty(0), np.empty((0, 2))
    tracks = Tracks(
        stamp_ns, keyframe, False, np.empty(0, np.int64), pairs, pairs, pairs, none, none, np.empty(0, np.uint8), session=0
    )
    return FrontEndOutput(tracks, measured)


def _after(*steps_ms: int, gap_sigma: float = 0.0) -> DeadReckoning:
    place, stamp = DeadReckoning(BEGIN, MOVING), BEGIN
    for step in steps_ms:
        place.add_frame(_frame(stamp + step * MS, _measured(stamp, stamp + step * MS, gap_sigma)))
        stamp += step * MS
    return place


def test_it_is_carried_by_the_imu_and_errs_ever_more() -> None:
    place = _after(400, 400, 400)
    np.testing.assert_allclose(place.at(BEGIN + 1200 * MS)[:3, 3], [0.024, 0.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(place.at(BEGIN + 400 * MS)[:3, 3], [0.008, 0.0, 0.0], atol=1e-5)
    assert _after(400).sigma_m < _after(400, 400).sigma_m < place.sigma_m < 0.02


def test_how_the_way_is_divided_does_not_change_how_far_it_errs() -> None:
    assert _after(400, 400, 400).sigma_m == pytest.approx(_after(1200).sigma_m, rel=1e-9)
    assert _after(1200).sigma_m == pytest.approx(np.hypot(2e-3 * 1.2, 0.5 * 1e-2 * 1.2**2), rel=1e-9)


def test_a_gap_makes_it_the_less_sure() -> None:
    sure, unsure = _after(200, 400), DeadReckoning(BEGIN, MOVING)
    unsure.add_frame(_frame(BEGIN + 200 * MS, _measured(BEGIN, BEGIN + 200 * MS, gap_sigma=5e-3)))
    unsure.add_frame(_frame(BEGIN + 600 * MS, _measured(BEGIN + 200 * MS, BEGIN + 600 * MS)))
    tilt = 5e-3 * np.sqrt(0.2)
    assert unsure.sigma_m > np.hypot(sure.sigma_m, 0.5 * GRAVITY * tilt * 0.4**2)


@pytest.mark.parametrize("measured", [None, _measured(BEGIN, BEGIN + 400 * MS, gap_sigma=0.5)])
def test_where_the_imu_says_nothing_it_stays_where_it_was_known_last(measured) -> None:
    place = DeadReckoning(BEGIN, MOVING)
    place.add_frame(_frame(BEGIN + 400 * MS, measured))
    place.add_frame(_frame(BEGIN + 800 * MS, _measured(BEGIN + 400 * MS, BEGIN + 800 * MS)))
    assert place.sigma_m == 0.05
    np.testing.assert_allclose(place.at(BEGIN + 800 * MS)[:3, 3], 0.0, atol=1e-12)


def test_at_the_beginning_of_a_map_the_place_is_known() -> None:
    place = DeadReckoning()
    place.add_frame(_frame(BEGIN, None))
    assert place.is_origin
    assert place.sigma_m == 0.0
