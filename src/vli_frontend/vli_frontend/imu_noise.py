"""The white noise of an IMU as it is measured, against what its data sheet promises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.calibration import ImuCalibration
from vli_frontend.synchroniser import ImuSegment

_ORDER = 4
_GAIN = 70.0**0.5
"""Of the fourth difference on white noise: the root of the sum of the squares of 1, −4, 6, −4, 1."""
_MIN_DIFFERENCES = 20
"""A fast scanner has fewer between two keyframes: they are collected."""
_MEMORY_S = 3.0
_WORSE = 1.3
"""Noise up to so many times the data sheet's passes as it: it is within what the tremor of a hand adds."""
_MAD = 1.4826


class NoiseMonitor:
    """Measures the noise densities of gyroscope and accelerometer while they move.

    The fourth difference of samples at rate f suppresses motion of frequency ν by (2 sin(π ν / f))⁴, for the tremor of a hand
    (12 Hz at 200 Hz) to 2 %, and leaves white noise √70-fold. Its median tells the noise whatever shocks there are.

    Args:
        imu: noise of the calibration.
    """

    def __init__(self, imu: ImuCalibration) -> None:
        self._promised = imu
        self._variance: FloatArray | None = None
        self._differences: list[FloatArray] = []
        self._collected_s = 0.0
        self.imu = imu
        """The calibration, with the noise that was measured where that is clearly worse."""

    def update(self, segment: ImuSegment) -> bool:
        """Take the samples of one keyframe interval; True where :attr:`imu` has changed."""
        steps = np.diff(segment.stamps[1:-1]) * 1e-9
        if len(steps) <= _ORDER or steps.max() > 1.5 * np.median(steps):
            return False
        self._differences.append(np.diff(np.concatenate([segment.gyro, segment.accel], axis=1)[1:-1], _ORDER, axis=0))
        self._collected_s += float(steps.sum())
        if sum(map(len, self._differences)) < _MIN_DIFFERENCES:
            return False
        differences, seconds = np.concatenate(self._differences), self._collected_s
        self._differences, self._collected_s = [], 0.0
        sigma = _MAD / _GAIN * np.median(np.abs(differences), axis=0).reshape(2, 3)
        variance = (sigma**2).mean(axis=1) * float(np.median(steps))
        weight = 1.0 if self._variance is None else min(1.0, seconds / _MEMORY_S)
        self._variance = variance if self._variance is None else (1 - weight) * self._variance + weight * variance
        return self._judge(np.sqrt(self._variance))

    def _judge(self, density: FloatArray) -> bool:
        promised = np.array([self._promised.gyroscope_noise_density, self._promised.accelerometer_noise_density])
        used = np.where(density > _WORSE * promised, density, promised)
        before = np.array([self.imu.gyroscope_noise_density, self.imu.accelerometer_noise_density])
        if (np.abs(used / before - 1.0) < 0.1).all():
            return False
        self.imu = replace(self._promised, gyroscope_noise_density=float(used[0]), accelerometer_noise_density=float(used[1]))
        return True
