"""Preintegration against closed forms, gaps and bias."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

from vli_common.calibration import ImuCalibration
from vli_common.geometry import so3_exp, so3_log
from vli_common.types import Counters, ImuBias, ImuSample, Preintegration
from vli_frontend.config import ImuConfig
from vli_frontend.preintegration import Preintegrator, combined_params, step_means
from vli_frontend.synchroniser import Synchroniser

MS = 1_000_000
IMU = ImuCalibration(200.0, 2e-3, 3e-4, 2.4e-4, 2e-5)
RATE = np.array([0.3, -0.2, 0.5])
FORCE = np.array([0.4, 0.1, 9.7])


class Rig:
    """A preintegrator with its samples."""

    def __init__(self, stamps_ms: Iterable[float], timeshift_ns: int = 0, ramp: float = 0.0) -> None:
        self.counters = Counters()
        synchroniser = Synchroniser(timeshift_ns, 50 * MS, True, self.counters)
        for t in stamps_ms:
            synchroniser.add_imu(ImuSample(round(t * MS), RATE * (1 + ramp * t), FORCE))
        self.preintegrator = Preintegrator(IMU, ImuConfig(), synchroniser, self.counters)

    def measure(self, begin_ms: float, end_ms: float) -> Preintegration:
        self.preintegrator.start(round(begin_ms * MS))
        found = self.preintegrator.to(round(end_ms * MS), 3)
        assert found is not None
        return found


def measurements(found: Preintegration) -> Any:
    return found.measurements


def test_a_constant_rate_gives_its_exponential_over_exactly_the_interval() -> None:
    found = Rig(range(0, 400, 5)).measure(12.3, 245.6)
    assert (found.from_ns, found.stamp_ns, found.session, found.inflate) == (12_300_000, 245_600_000, 3, 1.0)
    pim = measurements(found)
    assert pim.deltaTij() == pytest.approx(0.2333, abs=1e-12)
    np.testing.assert_allclose(pim.deltaRij().matrix(), so3_exp(RATE * 0.2333), atol=1e-9)


def test_a_ramp_is_integrated_exactly_by_midpoints_also_in_the_partial_steps() -> None:
    rig = Rig(range(0, 400, 5), ramp=0.01)
    direction = RATE / np.linalg.norm(RATE)
    angle = np.linalg.norm(RATE) * (0.2 + 0.01 * 0.5 * (213**2 - 13**2) / 1000)
    np.testing.assert_allclose(measurements(rig.measure(13, 213)).deltaRij().matrix(), so3_exp(direction * angle), atol=1e-9)


def test_gravity_does_not_lag_the_rotation() -> None:
    """An IMU that turns on the spot measures gravity from ever new sides; seen from where it began, that is one direction."""
    rig, gravity = Rig([]), np.array([0.0, 0.0, 9.81])
    for k in range(60):
        turned = so3_exp(RATE * 0.005 * k).T @ gravity
        rig.preintegrator._synchroniser.add_imu(ImuSample(k * 5 * MS, RATE, turned))
    pim = measurements(rig.measure(10, 210))
    begin = so3_exp(RATE * 0.010).T @ gravity
    np.testing.assert_allclose(pim.deltaVij(), 0.2 * begin, atol=2e-5)
    np.testing.assert_allclose(pim.deltaPij(), 0.5 * 0.2**2 * begin, atol=2e-6)


def test_without_rotation_position_and_velocity_are_those_of_constant_force() -> None:
    rig = Rig([])
    for k in range(60):
        rig.preintegrator._synchroniser.add_imu(ImuSample(k * 5 * MS, np.zeros(3), FORCE))
    pim = measurements(rig.measure(3, 203))
    np.testing.assert_allclose(pim.deltaVij(), FORCE * 0.2, rtol=1e-9)
    np.testing.assert_allclose(pim.deltaPij(), FORCE * 0.02, rtol=1e-6)


def test_the_interval_is_taken_on_the_clock_of_the_imu() -> None:
    plain = measurements(Rig(range(0, 400, 5), ramp=0.01).measure(20, 120)).deltaRij().matrix()
    shifted = measurements(Rig(range(0, 400, 5), timeshift_ns=8 * MS, ramp=0.01).measure(12, 112)).deltaRij().matrix()
    np.testing.assert_allclose(shifted, plain, atol=1e-12)


def test_an_answer_stays_as_it_is_when_the_interval_goes_on() -> None:
    rig = Rig(range(0, 400, 5))
    first = rig.measure(0.1, 100)
    before = measurements(first).deltaRij().matrix().copy()
    assert rig.preintegrator.to(200 * MS, 0) is not None
    np.testing.assert_array_equal(measurements(first).deltaRij().matrix(), before)


def test_there_is_no_answer_before_a_keyframe_or_without_samples() -> None:
    rig = Rig(range(0, 100, 5))
    assert rig.preintegrator.to(50 * MS, 0) is None
    rig.preintegrator.start(10 * MS)
    assert rig.preintegrator.to(200 * MS, 0) is None
    assert rig.counters["intervals_without_imu"] == 1


@pytest.mark.parametrize("gap_ms", [5, 50])
def test_a_gap_in_steady_motion_costs_nothing(gap_ms: int) -> None:
    rig = Rig([*range(0, 105, 5), *range(100 + gap_ms, 600, 5)])
    found = rig.measure(2, 480)
    assert found.inflate == pytest.approx(1.0)
    np.testing.assert_allclose(measurements(found).deltaRij().matrix(), so3_exp(RATE * 0.478), atol=1e-9)


def test_with_too_few_samples_to_tell_a_gap_may_hold_what_a_hand_does() -> None:
    found = Rig([*range(0, 25, 5), *range(320, 345, 5)]).measure(2, 335)
    turn, push = np.sqrt(np.diag(measurements(found).preintMeasCov())[[0, 6]])
    assert 0.01 < turn < 0.1
    assert 0.05 < push < 0.5


@pytest.mark.parametrize("gap_ms", [50, 100, 300])
@pytest.mark.parametrize("phase_ms", [0, 7, 20, 41])
def test_across_a_gap_the_covariance_covers_what_a_trembling_hand_did_in_it(gap_ms: int, phase_ms: int) -> None:
    def tremor(t_ms: float) -> float:
        return 0.4 * float(np.sin(2 * np.pi * 7.0 * 1e-3 * t_ms) + np.cos(2 * np.pi * 11.0 * 1e-3 * t_ms))

    def rig(gap: range) -> Rig:
        result = Rig([])
        for t in (t for t in range(0, 3000, 5) if t not in gap):
            result.preintegrator._synchroniser.add_imu(ImuSample(t * MS, RATE * (1 + tremor(t)), FORCE * (1 + tremor(t))))
        return result

    begin = 2500 + phase_ms
    whole = rig(range(0)).measure(begin - 60, begin + gap_ms + 60)
    cut = rig(range(begin, begin + gap_ms)).measure(begin - 60, begin + gap_ms + 60)
    turn = so3_log(measurements(whole).deltaRij().matrix().T @ measurements(cut).deltaRij().matrix())
    push = measurements(cut).deltaVij() - measurements(whole).deltaVij()
    sigma = np.sqrt(np.diag(measurements(cut).preintMeasCov()))
    assert np.linalg.norm(turn) < 3 * np.linalg.norm(sigma[:3])
    assert np.linalg.norm(push) < 3 * np.linalg.norm(sigma[6:9])
    assert whole.inflate == 1.0 < cut.inflate


def test_a_gap_at_the_start_of_an_interval_is_not_extrapolated_into() -> None:
    """The keyframe lies in a gap: what the curvature of later samples says must not reach over it."""
    stamps = [*range(0, 105, 5), *range(300, 600, 5)]
    rig = Rig([])
    for t in stamps:
        shake = np.sin(2 * np.pi * 10.0 * 1e-3 * t)
        rig.preintegrator._synchroniser.add_imu(ImuSample(t * MS, np.zeros(3), FORCE + np.array([0.0, 0.0, 0.5 * shake])))
    velocity = measurements(rig.measure(120, 400)).deltaVij()
    np.testing.assert_allclose(velocity, FORCE * 0.28, atol=0.5 * 0.28)


def test_a_gap_too_long_leaves_the_interval_without_a_factor_and_the_next_one_with() -> None:
    rig = Rig([*range(0, 105, 5), *range(2100, 2600, 5)])
    rig.preintegrator.start(50 * MS)
    assert rig.preintegrator.to(2200 * MS, 0) is None
    assert rig.measure(2200, 2300).inflate == 1.0


def test_a_bias_is_used_from_the_next_keyframe_on() -> None:
    rig = Rig(range(0, 400, 5))
    rig.preintegrator.start(10 * MS)
    rig.preintegrator.set_bias(ImuBias(0, RATE, np.zeros(3)))
    old, new = rig.preintegrator.to(100 * MS, 0), rig.measure(100, 200)
    assert old is not None
    np.testing.assert_array_equal(measurements(old).biasHat().gyroscope(), np.zeros(3))
    np.testing.assert_array_equal(measurements(new).biasHat().gyroscope(), RATE)
    np.testing.assert_allclose(measurements(new).deltaRij().matrix(), np.eye(3), atol=1e-12)


def test_reset_forgets_keyframe_and_bias() -> None:
    rig = Rig(range(0, 400, 5))
    rig.preintegrator.set_bias(ImuBias(0, RATE, np.zeros(3)))
    rig.preintegrator.start(10 * MS)
    rig.preintegrator.reset()
    assert rig.preintegrator.to(100 * MS, 0) is None
    np.testing.assert_array_equal(measurements(rig.measure(10, 100)).biasHat().gyroscope(), np.zeros(3))


def test_noise_is_that_of_the_calibration_times_the_factors() -> None:
    params = combined_params(IMU, ImuConfig(gyroscope_factor=3.0, accelerometer_noise=0.05, walk_factor=2.0))
    np.testing.assert_allclose(params.getGyroscopeCovariance(), np.eye(3) * (3 * 2.4e-4) ** 2)
    np.testing.assert_allclose(params.getAccelerometerCovariance(), np.eye(3) * 0.05**2)
    np.testing.assert_allclose(params.getBiasAccCovariance(), np.eye(3) * (2 * 3e-4) ** 2)
    np.testing.assert_allclose(params.getBiasOmegaCovariance(), np.eye(3) * (2 * 2e-5) ** 2)
    np.testing.assert_allclose(params.n_gravity, [0, 0, -9.81])


def test_an_accelerometer_worse_than_the_floor_keeps_its_own_noise() -> None:
    noisy = ImuCalibration(200.0, 0.1, 3e-4, 2.4e-4, 2e-5)
    np.testing.assert_allclose(combined_params(noisy, ImuConfig()).getAccelerometerCovariance(), np.eye(3) * 0.01)


def test_the_mean_over_a_step_does_not_lose_amplitude_at_the_frequencies_of_a_hand() -> None:
    omega, stamps = 2 * np.pi * 10.0, np.concatenate([[0.0], 0.002 + 0.005 * np.arange(40), [0.199]])
    values = np.repeat(np.sin(omega * stamps)[:, None], 3, axis=1)
    true = -np.diff(np.cos(omega * stamps)) / omega / np.diff(stamps)
    rule = 0.5 * (values[1:, 0] + values[:-1, 0])
    found = step_means(values, stamps)[:, 0]
    inner = slice(2, -2)
    assert np.abs(found - true)[inner].max() < 0.1 * np.abs(rule - true)[inner].max()


def test_a_gap_or_few_samples_leave_the_trapezoidal_rule() -> None:
    values = np.random.default_rng(0).normal(size=(12, 3))
    rule = 0.5 * (values[1:] + values[:-1])
    gap = np.concatenate([0.005 * np.arange(6), 0.08 + 0.005 * np.arange(6)])
    np.testing.assert_array_equal(step_means(values, gap), rule)
    np.testing.assert_array_equal(step_means(values[:4], gap[:4]), rule[:3])
