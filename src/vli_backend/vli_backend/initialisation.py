"""From nothing to a first window: at rest, or in motion.

The paper starts with two-view geometry and takes the scale from the laser afterwards. Here the stripe gives every feature a
metric first depth, so the keyframes are chained by PnP and adjusted together with the laser depths (eqs. 2 and 3) at once:
two-view geometry degenerates on the flat scenes of a scanner, this does not. Gyro bias, velocities and gravity follow
linearly from the preintegrated IMU, as in VINS-Mono (Qin et al., 2018, section V-B), with the scale already known.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from vli_backend.condense import Quadratic
from vli_backend.smoother import Condenser, KeyframeState
from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, pose, rotation_between, so3_exp, so3_log

GRAVITY = 9.81
"""m/s²; the world's z axis points up."""


@dataclass(frozen=True)
class ImuAlignment:
    """World rotation that makes z up, gyro bias (3,), velocities (K, 3) in it, length of gravity as found, m/s²."""

    R_map_world: FloatArray
    gyro_bias: FloatArray
    velocities: FloatArray
    gravity_norm: float


def rest_state(measurements: gtsam.PreintegratedCombinedMeasurements) -> KeyframeState:
    """Return the state of a sensor at rest from its preintegrated IMU: up is the specific force, the rotation is gyro bias."""
    elapsed = measurements.deltaTij()
    force = measurements.deltaVij() / elapsed
    gyro_bias = so3_log(measurements.deltaRij().matrix()) / elapsed + measurements.biasHatVector()[3:]
    R_map_imu = rotation_between(force, np.array([0.0, 0.0, 1.0]))
    # What the length of the force says of the bias; the rest of it cannot be told from tilt.
    accel_bias = force * (1.0 - GRAVITY / np.linalg.norm(force)) + measurements.biasHatVector()[:3]
    return KeyframeState(pose(R_map_imu, np.zeros(3)), np.zeros(3), gyro_bias, accel_bias)


def bundle_adjust(condenser: Condenser, T_map_camera: FloatArray, iterations: int) -> tuple[FloatArray, float]:
    """Levenberg–Marquardt over camera poses (K, 4, 4), the first held; return the poses and the final cost.

    Args:
        condenser: linearises the visual residuals at *camera* poses.
        T_map_camera: first guess.
        iterations: at most.
    """
    damping = 1e-3
    poses = T_map_camera
    quadratic = condenser(poses)
    for _ in range(iterations):
        step = _damped_step(quadratic, damping)
        trial = np.concatenate([poses[:1], np.stack([_retract(T, d) for T, d in zip(poses[1:], step, strict=True)])])
        tried = condenser(trial)
        if tried.constant < quadratic.constant:
            converged = quadratic.constant - tried.constant < 1e-4 * quadratic.constant
            poses, quadratic, damping = trial, tried, max(damping / 5, 1e-9)
            if converged:
                break
        else:
            damping *= 5
            if damping > 1e6:
                break
    return poses, quadratic.constant


def _damped_step(quadratic: Quadratic, damping: float) -> FloatArray:
    h = quadratic.hessian[6:, 6:]
    damped = h + np.diag(damping * np.diag(h) + 1e-9)
    return np.asarray(-np.linalg.solve(damped, quadratic.gradient[6:])).reshape(-1, 6)


def _retract(T: FloatArray, step: FloatArray) -> FloatArray:
    return pose(T[:3, :3] @ so3_exp(step[:3]), T[:3, 3] + T[:3, :3] @ step[3:])


def align_imu(T_world_imu: FloatArray, measurements: list[gtsam.PreintegratedCombinedMeasurements]) -> ImuAlignment:
    """Return gyro bias, gravity direction and velocities from metric keyframe poses (K, 4, 4) and the K − 1 preintegrations."""
    gyro_bias = _gyro_bias(T_world_imu, measurements)
    velocities, gravity = _velocities_and_gravity(T_world_imu, measurements, gyro_bias, None)
    norm = float(np.linalg.norm(gravity))
    # The length of gravity is known: a second pass with it fixed sharpens the velocities.
    for _ in range(3):
        velocities, gravity = _velocities_and_gravity(T_world_imu, measurements, gyro_bias, gravity)
    up = rotation_between(-gravity, np.array([0.0, 0.0, 1.0]))
    return ImuAlignment(up, gyro_bias, velocities @ up.T, norm)


def _gyro_bias(T_world_imu: FloatArray, measurements: list[gtsam.PreintegratedCombinedMeasurements]) -> FloatArray:
    rows: list[FloatArray] = []
    errors: list[FloatArray] = []
    base = measurements[0].biasHatVector()[3:]
    for k, pim in enumerate(measurements):
        measured = T_world_imu[k, :3, :3].T @ T_world_imu[k + 1, :3, :3]
        rows.append(_rotation_bias_jacobian(pim))
        errors.append(so3_log(measured) - so3_log(pim.deltaRij().matrix()))
    solution = np.linalg.lstsq(np.concatenate(rows), np.concatenate(errors), rcond=None)[0]
    result: FloatArray = base + solution
    return result


def _corrected_delta(
    pim: gtsam.PreintegratedCombinedMeasurements, gyro_bias: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ΔR (3, 3), Δp, Δv (3,) for a gyro bias: a prediction from the origin at rest, less the fall."""
    bias = gtsam.imuBias.ConstantBias(pim.biasHatVector()[:3], gyro_bias)
    nav = pim.predict(gtsam.NavState(), bias)
    fall, t = np.array([0.0, 0.0, -GRAVITY]), pim.deltaTij()
    return nav.pose().rotation().matrix(), nav.pose().translation() - 0.5 * t * t * fall, nav.velocity() - t * fall


def _rotation_bias_jacobian(pim: gtsam.PreintegratedCombinedMeasurements) -> FloatArray:
    """Return d Log(ΔR) / d gyro bias (3, 3), by differences: GTSAM keeps the exact one to itself."""
    step, base = 1e-4, pim.biasHatVector()[3:]
    columns: list[FloatArray] = []
    for axis in np.eye(3):
        ahead, behind = (so3_log(_corrected_delta(pim, base + sign * step * axis)[0]) for sign in (1.0, -1.0))
        columns.append((ahead - behind) / (2 * step))
    return np.stack(columns, axis=1)


def _velocities_and_gravity(
    T_world_imu: FloatArray,
    measurements: list[gtsam.PreintegratedCombinedMeasurements],
    gyro_bias: FloatArray,
    gravity: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    """Solve p_j = p_i + v_i t + ½ g t² + R_i Δp, v_j = v_i + g t + R_i Δv for v and g (|g| is known when a guess is given)."""
    count = len(T_world_imu)
    basis = np.eye(3) if gravity is None else _tangent_basis(gravity)
    fixed = np.zeros(3) if gravity is None else gravity * GRAVITY / np.linalg.norm(gravity)
    width = 3 * count + basis.shape[1]
    rows, values = [], []
    for k, pim in enumerate(measurements):
        t = pim.deltaTij()
        _, delta_p, delta_v = _corrected_delta(pim, gyro_bias)
        r_i, p_i, p_j = T_world_imu[k, :3, :3], T_world_imu[k, :3, 3], T_world_imu[k + 1, :3, 3]
        position, velocity = np.zeros((3, width)), np.zeros((3, width))
        position[:, 3 * k : 3 * k + 3] = t * np.eye(3)
        position[:, 3 * count :] = 0.5 * t * t * basis
        velocity[:, 3 * k : 3 * k + 3] = -np.eye(3)
        velocity[:, 3 * k + 3 : 3 * k + 6] = np.eye(3)
        velocity[:, 3 * count :] = -t * basis
        rows += [position / t, velocity]
        values += [(p_j - p_i - 0.5 * t * t * fixed - r_i @ delta_p) / t, t * fixed + r_i @ delta_v]
    solution = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)[0]
    found = fixed + basis @ solution[3 * count :]
    if gravity is not None:
        found = found * GRAVITY / np.linalg.norm(found)
    return solution[: 3 * count].reshape(-1, 3), found


def _tangent_basis(direction: FloatArray) -> FloatArray:
    """Return two unit columns (3, 2) perpendicular to a direction."""
    unit = direction / np.linalg.norm(direction)
    first = np.cross(unit, np.eye(3)[int(np.argmin(np.abs(unit)))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(unit, first)], axis=1)


def apply_alignment(T_world_imu: FloatArray, alignment: ImuAlignment) -> list[KeyframeState]:
    """Return the keyframe states in the gravity-aligned map, the first one at the origin."""
    origin = T_world_imu[0, :3, 3]
    states = []
    for T, velocity in zip(T_world_imu, alignment.velocities, strict=True):
        turned = pose(alignment.R_map_world @ T[:3, :3], alignment.R_map_world @ (T[:3, 3] - origin))
        states.append(KeyframeState(turned, velocity, alignment.gyro_bias, np.zeros(3)))
    return states


def chain_rotations(measurements: list[gtsam.PreintegratedCombinedMeasurements | None], T_cam_imu: FloatArray) -> FloatArray:
    """Return camera rotations (K, 3, 3) relative to the first keyframe from the gyro alone (identity where it is missing)."""
    R_cam_imu = T_cam_imu[:3, :3]
    rotations = [np.eye(3)]
    for pim in measurements:
        turn = pim.deltaRij().matrix() if pim is not None else np.eye(3)
        rotations.append(rotations[-1] @ R_cam_imu @ turn @ R_cam_imu.T)
    return np.stack(rotations)


def relative(T_a: FloatArray, T_b: FloatArray) -> FloatArray:
    """Return T_a⁻¹ T_b."""
    result: FloatArray = inverse(T_a) @ T_b
    return result
