"""The trajectory and what the IMU makes of it."""

from __future__ import annotations

import numpy as np
import pytest

from vli_common.geometry import inverse, so3_exp, so3_log, transform
from vli_simulation.config import MotionConfig, SimulationConfig, SimulationError, make_config
from vli_simulation.imu import record_imu
from vli_simulation.motion import Motion, ScanPath, plan_motion
from vli_simulation.rig import make_rig

PATH = ScanPath(np.array([0.1, -0.2, 0.3]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.6, 0.8]), 0.3)


def _plan(angle_deg: float = 0.0, seed: int = 0, **motion: float) -> Motion:
    config = SimulationConfig(motion=MotionConfig(**{"duration_s": 6.0, "passes": 2, **motion}))
    return plan_motion(config.motion, PATH, make_rig(config, seed), angle_deg, seed)


def test_noise_free_imu_integrates_to_the_true_poses() -> None:
    config = make_config("smoke", {"imu.noise_scale": 0.0, "imu.rate_hz": 2000.0, "motion.tremor": 2.0})
    trajectory = plan_motion(config.motion, PATH, make_rig(config, 4), 0.0, 4).trajectory
    imu = record_imu(trajectory, config.imu, 0, 4.0, 4)
    times = imu.stamps_ns / 1e9
    truth = trajectory.imu(times)
    rotation, velocity, position = truth.T_world_imu[0, :3, :3], truth.velocity[0], truth.T_world_imu[0, :3, 3]
    for n, dt in enumerate(np.diff(times)):
        middle = rotation @ so3_exp(0.25 * dt * (imu.gyro[n] + imu.gyro[n + 1]))
        force = middle @ (0.5 * (imu.accel[n] + imu.accel[n + 1])) - [0, 0, 9.81]
        position = position + velocity * dt + 0.5 * force * dt**2
        velocity = velocity + force * dt
        rotation = rotation @ so3_exp(0.5 * dt * (imu.gyro[n] + imu.gyro[n + 1]))
    assert np.linalg.norm(position - truth.T_world_imu[-1, :3, 3]) < 2e-5
    assert np.linalg.norm(so3_log(rotation.T @ truth.T_world_imu[-1, :3, :3])) < 2e-6


def test_camera_twist_is_the_derivative_of_the_camera_pose() -> None:
    trajectory = _plan(tremor=3.0).trajectory
    times, step = np.array([2.1, 3.3, 4.7]), 1e-4
    before, after = trajectory.camera_poses(times - step), trajectory.camera_poses(times + step)
    velocity, rate = trajectory.camera_twists(times)
    now = trajectory.camera_poses(times)
    moved = np.einsum("nji,nj->ni", now[:, :3, :3], (after - before)[:, :3, 3]) / (2 * step)
    turned = so3_log(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]) / (2 * step)
    np.testing.assert_allclose(velocity, moved, atol=1e-6)
    np.testing.assert_allclose(rate, turned, atol=1e-5)


def test_it_is_at_rest_until_it_is_told_to_move() -> None:
    rest = _plan(rest_s=1.5).trajectory.imu(np.linspace(0, 1.4, 50))
    assert np.ptp(rest.T_world_imu[:, :3, 3], axis=0).max() < 1e-8
    assert np.abs(rest.angular_velocity).max() < 1e-6
    moving = _plan(rest_s=0.0).trajectory.imu(np.zeros(1))
    assert np.linalg.norm(moving.velocity) > 0.008


def test_an_imu_at_rest_measures_gravity_upwards() -> None:
    config = make_config("smoke", {"imu.noise_scale": 0.0})
    trajectory = plan_motion(config.motion, PATH, make_rig(config, 1), 0.0, 1).trajectory
    imu = record_imu(trajectory, config.imu, 0, 1.0, 1)
    up = trajectory.imu(np.zeros(1)).T_world_imu[0, 2, :3]
    np.testing.assert_allclose(imu.accel[:100], 9.81 * np.tile(up, (100, 1)), atol=2e-4)


@pytest.mark.parametrize("angle_deg", [0.0, 90.0, 30.0, -120.0])
def test_it_moves_across_the_stripe(angle_deg: float) -> None:
    trajectory = _plan(angle_deg, tremor=0.0, sway=0.0, passes=1, rest_s=0.0).trajectory
    velocity = trajectory.camera_twists(np.array([3.0]))[0][0]
    across = [-np.sin(np.deg2rad(angle_deg)), np.cos(np.deg2rad(angle_deg)), 0]
    np.testing.assert_allclose(velocity, 0.014 * np.array(across), atol=2e-4)


def test_passes_go_back_and_forth_at_the_mean_speed() -> None:
    plan = _plan(tremor=0.0, sway=0.0, duration_s=13.5, passes=3)
    times = np.arange(0, 13.5, 0.001)
    x = plan.trajectory.camera_poses(times)[:, 0, 3]
    assert np.abs(np.diff(x)).sum() == pytest.approx(0.014 * 12.0, rel=2e-3)
    directions = [np.sign(np.interp(end - 0.4, times, x) - np.interp(end - 2.0, times, x)) for _, end in plan.passes]
    assert directions == [1, -1, 1]
    assert [round(bound, 3) for bounds in plan.passes for bound in bounds] == [0, 5.5, 5.5, 9.5, 9.5, 13.5]


def test_tremor_is_between_4_and_12_hz_and_can_be_turned_off() -> None:
    times = np.arange(0, 5, 0.002)
    config = {"rest_s": 0.0, "sway": 0.0, "speed": 0.0}
    still = _plan(tremor=0.0, **config).trajectory.imu(times)
    assert np.abs(still.acceleration).max() < 1e-6
    shaken = _plan(tremor=1.0, **config).trajectory.imu(times)
    spectrum = np.abs(np.fft.rfft(shaken.acceleration[:, 0] * np.hanning(len(times)))) ** 2
    frequency = np.fft.rfftfreq(len(times), 0.002)
    assert spectrum[(frequency > 3.5) & (frequency < 12.5)].sum() > 0.98 * spectrum.sum()


def test_the_camera_keeps_its_distance_to_the_surface() -> None:
    poses = _plan(tremor=0.0, sway=0.0, distance=0.05).trajectory.camera_poses(np.linspace(0, 6, 20))
    np.testing.assert_allclose((poses[:, :3, 3] - PATH.origin) @ PATH.normal, 0.05, atol=1e-6)
    in_camera = transform(inverse(poses[0]), PATH.origin[None] + 0.15 * PATH.direction)
    assert in_camera[0, 2] == pytest.approx(0.05, abs=1e-6)


def test_a_pass_longer_than_the_scene_is_refused() -> None:
    with pytest.raises(SimulationError, match=r"a pass of '.*' m is longer than the scene, which has 0.300 m; more --passes"):
        _plan(duration_s=60.0, passes=1)


def test_imu_noise_has_the_densities_of_the_calibration() -> None:
    config = make_config("full", {"motion.speed": 0.0, "motion.tremor": 0.0, "motion.sway": 0.0})
    rig = make_rig(config, 8)
    trajectory = plan_motion(config.motion, PATH, rig, 0.0, 8).trajectory
    imu = record_imu(trajectory, config.imu, 0, 130.0, 8)
    for measured, density in ((imu.gyro - imu.gyro_bias, "gyroscope"), (imu.accel - imu.accel_bias, "accelerometer")):
        expected = rig.document["imu0"][f"{density}_noise_density"] * np.sqrt(200)
        np.testing.assert_allclose(measured.std(axis=0), expected, rtol=0.03)
    walk = np.diff(imu.gyro_bias, axis=0).std() * np.sqrt(200)
    assert walk == pytest.approx(rig.document["imu0"]["gyroscope_random_walk"], rel=0.03)
