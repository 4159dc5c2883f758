"""The inertial measurement unit: exact angular rate and specific force, with white noise, constant bias and bias walk."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vli_common.arrays import FloatArray, IntArray
from vli_common.types import NANOSECONDS, ImuSample
from vli_simulation.config import ImuConfig
from vli_simulation.motion import Trajectory

GRAVITY = 9.81
"""m/s², along −z of the world."""
_LEAD_S = 0.1
"""IMU samples before the first frame and after the last one, so that the camera's stamps lie within them."""


@dataclass(frozen=True)
class ImuRecording:
    """N samples: stamps (N,) ns, rate (N, 3) rad/s, specific force (N, 3) m/s², and the true biases (N, 3)."""

    stamps_ns: IntArray
    gyro: FloatArray
    accel: FloatArray
    gyro_bias: FloatArray
    accel_bias: FloatArray

    def __iter__(self) -> Iterator[ImuSample]:
        """Yield sample by sample."""
        for stamp, gyro, accel in zip(self.stamps_ns, self.gyro, self.accel, strict=True):
            yield ImuSample(int(stamp), gyro, accel)


def record_imu(trajectory: Trajectory, config: ImuConfig, start_ns: int, duration_s: float, seed: int) -> ImuRecording:
    """Return what the IMU measures from 0.1 s before the first frame to 0.1 s after ``duration_s``."""
    count = int((duration_s + 2 * _LEAD_S) * config.rate_hz)
    offsets_ns = np.round((np.arange(count) / config.rate_hz - _LEAD_S) * NANOSECONDS).astype(np.int64)
    state = trajectory.imu(offsets_ns / NANOSECONDS)
    force = np.einsum("nji,nj->ni", state.T_world_imu[:, :3, :3], state.acceleration + np.array([0.0, 0.0, GRAVITY]))
    return _measured(offsets_ns + start_ns, state.angular_velocity, force, config, np.random.default_rng([seed, 3]))


def record_rest(config: ImuConfig, start_ns: int, duration_s: float, seed: int) -> ImuRecording:
    """Return what the IMU measures while it lies still, in an attitude that is drawn from the seed."""
    count = int(duration_s * config.rate_hz)
    offsets_ns = np.round(np.arange(count) * (NANOSECONDS / config.rate_hz)).astype(np.int64)
    rng = np.random.default_rng([seed, 20])
    up = np.array([0.0, 0.0, 1.0]) + rng.normal(0, 0.1, 3)
    force = np.broadcast_to(GRAVITY * up / np.linalg.norm(up), (count, 3))
    return _measured(offsets_ns + start_ns, np.zeros((count, 3)), force, config, rng)


def _measured(
    stamps_ns: IntArray, rate: FloatArray, force: FloatArray, config: ImuConfig, rng: np.random.Generator
) -> ImuRecording:
    count = len(stamps_ns)
    gyro_bias = _bias(rng, count, config, config.gyroscope_bias, config.gyroscope_random_walk)
    accel_bias = _bias(rng, count, config, config.accelerometer_bias, config.accelerometer_random_walk)
    gyro_noise = _white(rng, count, config, config.gyroscope_noise_density)
    accel_noise = _white(rng, count, config, config.accelerometer_noise_density)
    return ImuRecording(stamps_ns, rate + gyro_bias + gyro_noise, force + accel_bias + accel_noise, gyro_bias, accel_bias)


def _bias(rng: np.random.Generator, count: int, config: ImuConfig, constant: float, walk: float) -> FloatArray:
    steps = rng.normal(0, walk / np.sqrt(config.rate_hz), (count, 3))
    steps[0] = rng.normal(0, constant, 3)
    result: FloatArray = config.noise_scale * np.cumsum(steps, axis=0)
    return result


def _white(rng: np.random.Generator, count: int, config: ImuConfig, density: float) -> FloatArray:
    result: FloatArray = config.noise_scale * density * np.sqrt(config.rate_hz) * rng.standard_normal((count, 3))
    return result
