"""What the IMU says of a visual path: scale, gravity, velocities, biases; and how sure that is."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from scene import T_CAM_IMU, Motion

from vli_backend.inertial_alignment import AlignmentSigmas, InertialAlignment, VisualInterval, align_structure
from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, pose, so3_exp

GYRO_BIAS, ACCEL_BIAS = np.array([0.004, -0.003, 0.002]), np.array([0.05, -0.04, 0.03])
SIGMAS = AlignmentSigmas(4e-3, 5e-4, 2e-5, 3e-4, 0.2, 0.02)
FRAME_S, IMU_S, EVERY, BEGIN_S = 1.0 / 30.0, 0.005, 5, 2.0
UNIT = 0.6
"""Metres a unit of the visual world."""
WORLD = so3_exp(np.array([0.4, -0.2, 1.0]))
"""Rotation of the visual world against the true one."""


def _measure(
    motion: Motion, times: FloatArray, noise: float, rng: np.random.Generator
) -> list[gtsam.PreintegratedCombinedMeasurements]:
    """Return the preintegrations from the first time to each later one; they share their samples."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
    count = len(times) - 1
    found = [gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias()) for _ in range(count)]
    for i in range(count):
        steps = round((times[i + 1] - times[i]) / IMU_S)
        dt = (times[i + 1] - times[i]) / steps
        for k in range(steps):
            rate, force = motion.imu(times[i] + (k + 0.5) * dt)
            force = force + ACCEL_BIAS + rng.normal(size=3) * noise / np.sqrt(dt)
            for measurements in found[i:]:
                measurements.integrateMeasurement(force, rate + GYRO_BIAS, dt)
    return found


def _align(motion: Motion, visual: float = 5e-6, noise: float = 2e-3) -> InertialAlignment:
    """Return the alignment of ten keyframes, five frames apart, seen with noise in position (m) and acceleration (m/s²/√Hz)."""
    rng = np.random.default_rng(1)
    times = BEGIN_S + FRAME_S * np.arange(9 * EVERY + 1)
    seen = pose(WORLD, np.zeros(3)) @ np.stack([motion.camera(t) for t in times])
    seen[:, :3, 3] = (seen[:, :3, 3] + rng.normal(scale=visual, size=(len(seen), 3))) / UNIT
    body = pose(seen[:, :3, :3] @ T_CAM_IMU[:3, :3], seen[:, :3, 3])
    intervals = []
    for k in range(0, len(times) - 1, EVERY):
        inner = body[k + 1 : k + 1 + EVERY]
        measurements = _measure(motion, times[k : k + 1 + EVERY], noise, rng)
        intervals.append(VisualInterval(inner[:, :3, 3], inner[:, :3, :3], measurements))
    return align_structure(body[::EVERY], intervals, inverse(T_CAM_IMU)[:3, 3], SIGMAS)


def test_scale_gravity_and_velocities_come_out_of_a_hand_held_motion() -> None:
    motion = Motion(rest_s=0.0, tremor=2.0)
    found = _align(motion)
    assert found.scale == pytest.approx(UNIT, rel=0.05)
    assert 0.001 < found.scale_sigma < 0.1
    assert found.gravity_norm == pytest.approx(9.81, abs=0.3)
    down = WORLD @ np.array([0.0, 0.0, -1.0])
    # Tilt and accelerometer bias cannot be told apart in a second and a half.
    assert np.arccos(found.gravity @ down / 9.81) < 0.01
    np.testing.assert_allclose(found.gyro_bias, GYRO_BIAS, atol=5e-4)
    h = 1e-3
    for k, velocity in enumerate(found.velocities):
        t = BEGIN_S + k * EVERY * FRAME_S
        true = WORLD @ (motion.imu_pose(t + h)[:3, 3] - motion.imu_pose(t - h)[:3, 3]) / (2 * h)
        np.testing.assert_allclose(velocity, true, atol=3e-3)


@pytest.mark.parametrize("tremor", [1.0, 2.0, 4.0])
def test_the_reported_spread_of_the_scale_holds(tremor: float) -> None:
    found = _align(Motion(rest_s=0.0, tremor=tremor))
    assert abs(found.scale / UNIT - 1.0) < 3.0 * found.scale_sigma


def test_noise_of_the_images_does_not_shrink_the_scale() -> None:
    quiet, noisy = (_align(Motion(rest_s=0.0, tremor=2.0), visual=visual, noise=0.0) for visual in (0.0, 1.5e-5))
    assert noisy.scale == pytest.approx(quiet.scale, rel=0.05)


def test_an_even_motion_leaves_the_scale_open_and_says_so() -> None:
    even, lively = _align(Motion(rest_s=0.0, tremor=0.0)), _align(Motion(rest_s=0.0, tremor=3.0))
    assert even.scale_sigma > 3.0 * lively.scale_sigma
    assert even.scale_sigma > 0.1
