"""The noise of an IMU from its samples in motion."""

from __future__ import annotations

import numpy as np
import pytest

from vli_common.calibration import ImuCalibration
from vli_frontend.imu_noise import NoiseMonitor
from vli_frontend.synchroniser import ImuSegment

IMU = ImuCalibration(200.0, 2e-3, 3e-4, 2.4e-4, 2e-5)


def segment(rng: np.random.Generator, scale: float, start_s: float, tremor: float = 1.0, rate_hz: float = 200.0) -> ImuSegment:
    """Return 0.33 s of a shaking hand: 0.1 rad/s and 3 m/s² at 12 Hz, noise of the data sheet times ``scale``."""
    stamps = np.round((start_s + np.arange(0, 0.33, 1 / rate_hz)) * 1e9).astype(np.int64)
    shake = tremor * np.sin(2 * np.pi * 12 * stamps[:, None] * 1e-9 + np.array([0.0, 1.0, 2.0]))
    noise = scale * np.sqrt(rate_hz) * rng.normal(size=(len(stamps), 6))
    gyro = 0.1 * shake + IMU.gyroscope_noise_density * noise[:, :3] + 0.01
    accel = 3.0 * shake + IMU.accelerometer_noise_density * noise[:, 3:] + np.array([0.0, 0.0, 9.81])
    return ImuSegment(stamps, gyro, accel, np.full(len(stamps) - 1, 5_000_000))


def monitored(scale: float, tremor: float = 1.0, intervals: int = 30) -> NoiseMonitor:
    rng, monitor = np.random.default_rng(4), NoiseMonitor(IMU)
    for index in range(intervals):
        monitor.update(segment(rng, scale, 0.33 * index, tremor))
    return monitor


def test_noise_as_promised_leaves_the_calibration_as_it_is_under_tremor_too() -> None:
    assert monitored(1.0, 0.0).imu is IMU
    assert monitored(1.0, 0.3).imu is IMU


@pytest.mark.parametrize("tremor", [0.0, 0.3])
def test_noise_five_times_worse_is_found(tremor: float) -> None:
    found = monitored(5.0, tremor).imu
    assert found.gyroscope_noise_density == pytest.approx(5 * IMU.gyroscope_noise_density, rel=0.15)
    assert found.accelerometer_noise_density == pytest.approx(5 * IMU.accelerometer_noise_density, rel=0.15)
    assert found.gyroscope_random_walk == IMU.gyroscope_random_walk


def test_short_intervals_of_a_fast_scanner_are_collected() -> None:
    rng, monitor = np.random.default_rng(8), NoiseMonitor(IMU)
    for index in range(40):
        whole = segment(rng, 5.0, 0.33 * index, 0.3)
        monitor.update(ImuSegment(whole.stamps[:21], whole.gyro[:21], whole.accel[:21], 5_000_000))
    assert monitor.imu.gyroscope_noise_density == pytest.approx(5 * IMU.gyroscope_noise_density, rel=0.2)


def test_a_shock_does_not_count_as_noise() -> None:
    rng, monitor = np.random.default_rng(5), NoiseMonitor(IMU)
    for index in range(20):
        struck = segment(rng, 1.0, 0.33 * index, 0.0)
        struck.accel[30:34] += 20.0
        assert not monitor.update(struck)


def test_intervals_with_gaps_or_few_samples_say_nothing() -> None:
    rng, monitor = np.random.default_rng(6), NoiseMonitor(IMU)
    whole = segment(rng, 9.0, 0.0)
    assert not monitor.update(ImuSegment(whole.stamps[:20], whole.gyro[:20], whole.accel[:20], 5_000_000))
    gap = np.r_[0:30, 40 : len(whole.stamps)]
    assert not monitor.update(ImuSegment(whole.stamps[gap], whole.gyro[gap], whole.accel[gap], 55_000_000))
    assert monitor.update(whole)


def test_it_believes_the_calibration_again_when_the_noise_is_gone() -> None:
    rng, monitor = np.random.default_rng(7), NoiseMonitor(IMU)
    for index in range(120):
        monitor.update(segment(rng, 5.0 if index < 20 else 1.0, 0.33 * index, 0.0))
    assert monitor.imu.gyroscope_noise_density == pytest.approx(IMU.gyroscope_noise_density)
