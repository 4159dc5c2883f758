"""The hand's motion as one smooth curve whose derivatives are exact.

A plan (passes, sway, tremor) is sampled every 10 ms and interpolated by quintic splines: position and rotation vector of
``imu_link``. The spline, not the plan, is the truth: poses, angular rate and acceleration are all read from it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, pose, skew, so3_exp, so3_log
from vli_simulation.config import MotionConfig, SimulationError
from vli_simulation.rig import Rig

NODE_S = 0.01
"""Spacing of the samples that the spline goes through."""
MARGIN_S = 0.5
"""Samples before the first frame and after the last one."""
RAMP_S = 0.6
"""From rest to full motion."""
_SWAY_HZ = (0.08, 0.6)
_TREMOR_HZ = (4.0, 12.0)
_SWAY_M = np.array([0.8e-3, 2.2e-3, 1.6e-3])
"""Along the pass, across it, away from the surface: one standard deviation."""
_SWAY_RAD = np.deg2rad([1.8, 1.8, 1.4])
_TREMOR_M = np.array([1.0e-4, 1.0e-4, 0.8e-4])
_TREMOR_RAD = np.deg2rad([0.09, 0.09, 0.09])


@dataclass(frozen=True)
class ScanPath:
    """Where a scene wants to be scanned: a straight line on its surface, in the gravity-aligned world.

    Args:
        origin: (3,) start of the line.
        direction: (3,) unit, along the first pass.
        normal: (3,) unit, from the surface to the camera.
        length: metres that may be scanned.
    """

    origin: FloatArray
    direction: FloatArray
    normal: FloatArray
    length: float


@dataclass(frozen=True)
class Kinematics:
    """State of ``imu_link`` at N instants: poses (N, 4, 4), rate in the body, velocity and acceleration in the world (N, 3)."""

    T_world_imu: FloatArray
    angular_velocity: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


class Trajectory:
    """A twice differentiable path of ``imu_link``; time is in seconds since the first frame."""

    def __init__(self, times_s: FloatArray, T_world_imu: FloatArray, T_imu_cam: FloatArray) -> None:
        self._reference = T_world_imu[len(times_s) // 2, :3, :3]
        vectors = so3_log(self._reference.T @ T_world_imu[:, :3, :3])
        self._position: BSpline = make_interp_spline(times_s, T_world_imu[:, :3, 3], k=5)
        self._rotation: BSpline = make_interp_spline(times_s, vectors, k=5)
        self._rotation_rate = self._rotation.derivative()
        self._T_imu_cam = T_imu_cam

    def imu(self, times_s: FloatArray) -> Kinematics:
        """Return the state of ``imu_link`` at times (N,)."""
        vectors = self._rotation(times_s)
        rotation = self._reference @ so3_exp(vectors)
        rate = np.einsum("nij,nj->ni", _right_jacobians(vectors), self._rotation_rate(times_s))
        return Kinematics(pose(rotation, self._position(times_s)), rate, self._position(times_s, 1), self._position(times_s, 2))

    def camera_poses(self, times_s: FloatArray) -> FloatArray:
        """Return T_world_camera (N, 4, 4) at times (N,)."""
        result: FloatArray = self.imu(times_s).T_world_imu @ self._T_imu_cam
        return result

    def camera_twists(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (velocity, angular velocity) of the camera in the camera frame, (N, 3) each, at times (N,)."""
        state = self.imu(times_s)
        R_imu_cam, lever = self._T_imu_cam[:3, :3], self._T_imu_cam[:3, 3]
        velocity_imu = np.einsum("nji,nj->ni", state.T_world_imu[:, :3, :3], state.velocity)
        return (velocity_imu + np.cross(state.angular_velocity, lever)) @ R_imu_cam, state.angular_velocity @ R_imu_cam


@dataclass(frozen=True)
class Motion:
    """A planned scan: its trajectory and the start and end of each pass in seconds since the first frame."""

    trajectory: Trajectory
    passes: list[tuple[float, float]]


def plan_motion(config: MotionConfig, path: ScanPath, rig: Rig, stripe_angle_deg: float, seed: int) -> Motion:
    """Return a hand-held scan along ``path``, perpendicular to the stripe.

    Raises:
        SimulationError: the passes are longer than the scene.
    """
    rng = np.random.default_rng([seed, 2])
    times = np.arange(-MARGIN_S, config.duration_s + MARGIN_S + NODE_S, NODE_S)
    along, bounds = _progress(config, times)
    if (reach := float(np.ptp(along))) > path.length:
        raise SimulationError(
            f"a pass of '{reach:.3f}' m is longer than the scene, which has {path.length:.3f} m; "
            "more --passes or less --speed or --duration"
        )
    along = along + 0.5 * (path.length - reach)
    envelope = smooth_step((times - config.rest_s) / RAMP_S) if config.rest_s > 0 else np.ones_like(times)
    wander, turn = _hand(config, times, rng)
    R_world_cam = _camera_axes(path, np.deg2rad(stripe_angle_deg))
    lateral = np.cross(path.normal, path.direction)
    axes = np.stack([path.direction, lateral, path.normal])
    position = path.origin + along[:, None] * path.direction + config.distance * path.normal + (envelope[:, None] * wander) @ axes
    T_world_cam = pose(R_world_cam @ so3_exp(envelope[:, None] * turn), position)
    return Motion(Trajectory(times, T_world_cam @ rig.T_cam_imu, inverse(rig.T_cam_imu)), bounds)


def _progress(config: MotionConfig, times: FloatArray) -> tuple[FloatArray, list[tuple[float, float]]]:
    """Return metres along the path at each time and the passes' bounds; the mean speed while moving is the one asked for."""
    moving = config.duration_s - config.rest_s
    if moving <= 0:
        return np.zeros_like(times), [(0.0, config.duration_s)]
    turns = config.rest_s + moving * np.arange(config.passes + 1) / config.passes
    velocity = smooth_step((times - config.rest_s) / RAMP_S) if config.rest_s > 0 else np.ones_like(times)
    for index, turn in enumerate(turns[1:-1]):
        velocity = velocity - 2 * (-1) ** index * smooth_step((times - turn) / RAMP_S + 0.5)
    inside = (times >= 0) & (times <= config.duration_s)
    mean = float(np.abs(velocity[inside]).sum() * NODE_S / moving)
    velocity = velocity * config.speed / mean
    along = np.concatenate([[0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * NODE_S)])
    starts = [0.0, *turns[1:]]
    return along - along[inside].min(), list(itertools.pairwise(starts))


def _hand(config: MotionConfig, times: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return wandering (N, 3) metres along, across, away from the surface; rotation vectors (N, 3) in the camera frame."""
    sway = oscillation(rng, times, _SWAY_HZ, 5) * config.sway
    shake, shake_turn = hand_tremor(rng, times, config.tremor)
    reach = config.distance / 0.03
    return reach * sway[:, :3] * _SWAY_M + shake, sway[:, 3:] * _SWAY_RAD + shake_turn


def hand_tremor(rng: np.random.Generator, times: FloatArray, scale: float) -> tuple[FloatArray, FloatArray]:
    """Return the hand's tremor at times (N,): metres (N, 3) and rotation vectors (N, 3)."""
    tremor = oscillation(rng, times, _TREMOR_HZ, 8) * scale
    return tremor[:, :3] * _TREMOR_M, tremor[:, 3:] * _TREMOR_RAD


def oscillation(rng: np.random.Generator, times: FloatArray, band_hz: tuple[float, float], count: int) -> FloatArray:
    """Return six independent sums of sinusoids (N, 6) of unit variance; amplitudes fall with frequency."""
    frequency = np.sort(rng.uniform(*band_hz, (6, count)), axis=1)
    amplitude = rng.uniform(0.5, 1.0, (6, count)) * band_hz[0] / frequency
    amplitude *= np.sqrt(2.0 / (amplitude**2).sum(axis=1, keepdims=True))
    phase = rng.uniform(0, 2 * np.pi, (6, count))
    result: FloatArray = np.einsum("kc,nkc->nk", amplitude, np.sin(2 * np.pi * frequency * times[:, None, None] + phase))
    return result


def _camera_axes(path: ScanPath, stripe_angle: float) -> FloatArray:
    """Return R_world_cam that looks against the normal and moves across the stripe."""
    forward = -path.normal
    along_stripe = np.cross(path.direction, forward)
    x = np.cos(stripe_angle) * along_stripe - np.sin(stripe_angle) * path.direction
    y = np.sin(stripe_angle) * along_stripe + np.cos(stripe_angle) * path.direction
    return np.stack([x, y, forward], axis=1)


def smooth_step(x: FloatArray) -> FloatArray:
    """Return a step from 0 to 1 over x in [0, 1] with four continuous derivatives."""
    x = np.clip(x, 0.0, 1.0)
    result: FloatArray = x**5 * (126 - 420 * x + 540 * x**2 - 315 * x**3 + 70 * x**4)
    return result


def _right_jacobians(vectors: FloatArray) -> FloatArray:
    """Return the right Jacobians of SO(3), (N, 3, 3), of rotation vectors (N, 3)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    b = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    k = skew(vectors)
    result: FloatArray = np.eye(3) - a * k + b * (k @ k)
    return result
