"""Scale, gravity, velocities and biases of a purely visual structure from the IMU, at the rate of the frames.

Visual-inertial initialisation without a laser: structure from motion gives the path of the camera up to its scale, and the
preintegrated IMU says how long it is. As in VINS-Mono (Qin et al., 2018, section V-B) the problem is linear once the gyroscope
bias is known, but two things are taken from the inertial-only estimate of Campos et al. (2020): every term has its covariance, so
that the scale comes with a standard deviation which tells when the motion has sufficed; and biases have priors. Two things are
done for a hand-held scanner at 30 mm: *every* frame takes part, not only keyframes, since the tremor of a hand, which is most of
its acceleration, is faster than these; and the attitude of a keyframe may err by what images leave open, as half a milliradian
of it turns into more acceleration than the hand has.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from vli_common.arrays import FloatArray
from vli_common.geometry import skew, so3_exp, so3_log

GRAVITY = 9.81
"""m/s²; the world's z axis points up."""

_ITERATIONS = 8
_CONVERGED = 1e-5
"""Relative step of the scale."""


@dataclass(frozen=True)
class VisualInterval:
    """Frames after one keyframe, up to and with the next one.

    Args:
        centres: (M, 3) of the camera in the visual world, any unit; the last is the next keyframe's.
        rotations: (M, 3, 3) ``R_world_imu``.
        measurements: M preintegrations from the keyframe to each of them.
    """

    centres: FloatArray
    rotations: FloatArray
    measurements: list[gtsam.PreintegratedCombinedMeasurements]

    @cached_property
    def deltas(self) -> Deltas:
        """What the IMU says of it; a third of the work of an alignment, so it is asked for while there is time."""
        return _deltas(self.measurements)


@dataclass(frozen=True)
class AlignmentSigmas:
    """Standard deviations of what goes into the alignment.

    Args:
        accelerometer: m/s²/√Hz.
        gyroscope: rad/s/√Hz.
        position: of a frame's camera centre, units of the visual world.
        rotation: of a keyframe's attitude from images, rad.
        accel_bias: prior, m/s².
        gyro_bias: prior, rad/s.
    """

    accelerometer: float
    gyroscope: float
    position: float
    rotation: float
    accel_bias: float
    gyro_bias: float


@dataclass(frozen=True)
class InertialAlignment:
    """What the IMU says of a visual structure with K keyframes.

    Args:
        scale: metres a unit of the visual world.
        scale_sigma: its relative standard deviation.
        gravity: (3,) in the visual world, m/s², downwards.
        gravity_norm: its length before it was held at 9.81, m/s².
        velocities: (K, 3) of the IMU in the visual world, m/s.
        rotations: (K, 3, 3) ``R_world_imu``, corrected.
        accel_bias, gyro_bias: (3,).
        chi: RMS of the residuals in sigmas.
    """

    scale: float
    scale_sigma: float
    gravity: FloatArray
    gravity_norm: float
    velocities: FloatArray
    rotations: FloatArray
    accel_bias: FloatArray
    gyro_bias: FloatArray
    chi: float


@dataclass(frozen=True)
class Deltas:
    """Preintegrated Δp, Δv (M, 3), their Jacobians (M, 3, 6) on [accelerometer, gyro] bias, and the last ΔR with its own."""

    times: FloatArray
    position: FloatArray
    velocity: FloatArray
    position_jacobian: FloatArray
    velocity_jacobian: FloatArray
    rotation: FloatArray
    rotation_jacobian: FloatArray


def align_structure(
    T_world_keyframe: FloatArray, intervals: list[VisualInterval], lever: FloatArray, sigmas: AlignmentSigmas
) -> InertialAlignment:
    """Find scale, gravity, velocities, biases and small corrections of the attitudes, all at once, by Gauss–Newton.

    Args:
        T_world_keyframe: (K, 4, 4), rotation ``R_world_imu`` and *camera* centre of each keyframe in the visual world.
        intervals: the K − 1 between them.
        lever: (3,) the camera's centre in ``imu_link``, metres.
        sigmas: see there.
    """
    problem = _Problem(T_world_keyframe, intervals, lever, sigmas)
    gravity_norm = 0.0
    for iteration in range(_ITERATIONS):
        change = problem.step(gravity_is_free=iteration == 0)
        if iteration == 0:
            gravity_norm = float(np.linalg.norm(problem.gravity))
            problem.gravity *= GRAVITY / max(gravity_norm, 1e-9)
        elif change < _CONVERGED:
            break
    return problem.solution(gravity_norm)


class _Problem:
    """Unknowns: scale, both biases, gravity, then velocity and attitude correction of each keyframe."""

    def __init__(
        self, T_world_keyframe: FloatArray, intervals: list[VisualInterval], lever: FloatArray, sigmas: AlignmentSigmas
    ) -> None:
        self._count = len(T_world_keyframe)
        self._rotations, self._centres = T_world_keyframe[:, :3, :3], T_world_keyframe[:, :3, 3]
        self._visual_rotations = self._rotations
        self._intervals, self._lever, self._sigmas = intervals, lever, sigmas
        self._deltas = [interval.deltas for interval in intervals]
        self._scale, self._bias = 1.0, np.zeros(6)
        self._velocities = np.zeros((self._count, 3))
        self.gravity = np.zeros(3)
        self._information = np.empty((0, 0))
        self._chi = np.inf

    def step(self, gravity_is_free: bool) -> float:
        """Linearise, solve, and move; return the relative change of the scale. ``gravity`` keeps its length unless it is free."""
        basis = np.eye(3) if gravity_is_free else _tangent_basis(self.gravity)
        head = 7 + basis.shape[1]
        width = head + 6 * self._count
        rows: list[FloatArray] = []
        errors: list[FloatArray] = []
        for k in range(self._count - 1):
            for jacobian, error in (self._motion_rows(k, basis, width, not gravity_is_free), self._turn_rows(k, head, width)):
                rows.append(jacobian)
                errors.append(error)
        jacobian, error = self._prior_rows(head, width)
        rows.append(jacobian)
        errors.append(error)
        a, b = np.concatenate(rows), np.concatenate(errors)
        self._information = a.T @ a
        step: FloatArray = np.linalg.lstsq(a, -b, rcond=None)[0].astype(np.float64)
        self._chi = float(np.sqrt(((b + a @ step) ** 2).sum() / max(1, len(b) - width)))
        self._move(step, basis, head, gravity_is_free)
        return abs(float(step[0])) / max(abs(self._scale), 1e-9)

    def solution(self, gravity_norm: float) -> InertialAlignment:
        """Return what was found."""
        variance = np.linalg.pinv(self._information)[0, 0]
        sigma = np.sqrt(variance) / abs(self._scale) * max(1.0, self._chi)
        velocities, rotations = self._velocities, self._rotations
        bias = self._bias
        return InertialAlignment(
            self._scale, float(sigma), self.gravity, gravity_norm, velocities, rotations, bias[:3], bias[3:], self._chi
        )

    def _motion_rows(self, k: int, basis: FloatArray, width: int, total: bool) -> tuple[FloatArray, FloatArray]:
        """p_i = p_k + v_k t + ½ g t² + R_k Δp_i of every frame, and v_k+1 = v_k + g t + R_k Δv of the last, whitened together."""
        interval, delta, R = self._intervals[k], self._deltas[k], self._rotations[k]
        t, head, frames = delta.times, 7 + basis.shape[1], len(delta.times)
        alpha = delta.position + delta.position_jacobian @ self._bias
        beta = delta.velocity[-1] + delta.velocity_jacobian[-1] @ self._bias
        shift = interval.centres - self._centres[k]
        swing = (interval.rotations - self._visual_rotations[k]) @ self._lever
        fall = t[:, None] * self._velocities[k] + 0.5 * t[:, None] ** 2 * self.gravity
        jacobian, error = np.zeros((frames + 1, 3, width)), np.zeros((frames + 1, 3))
        error[:frames] = self._scale * shift - swing - fall - alpha @ R.T
        error[frames] = self._velocities[k + 1] - self._velocities[k] - self.gravity * t[-1] - R @ beta
        jacobian[:frames, :, 0] = shift
        jacobian[:frames, :, 1:7] = -R @ delta.position_jacobian
        jacobian[frames, :, 1:7] = -R @ delta.velocity_jacobian[-1]
        jacobian[:frames, :, 7:head] = -0.5 * (t**2)[:, None, None] * basis
        jacobian[frames, :, 7:head] = -t[-1] * basis
        at = head + 6 * k
        jacobian[:frames, :, at : at + 3] = -t[:, None, None] * np.eye(3)
        jacobian[frames, :, at : at + 3] = -np.eye(3)
        jacobian[:frames, :, at + 3 : at + 6] = R @ skew(alpha)
        jacobian[frames, :, at + 3 : at + 6] = R @ skew(beta)
        jacobian[frames, :, at + 6 : at + 9] = np.eye(3)
        small = 1e-4 * self._scale
        whitener, more, less = self._whiteners(t, self._scale + np.array([0.0, small, -small]))
        white = (whitener @ jacobian.reshape(frames + 1, -1)).reshape(-1, width)
        if total:
            # Positions from images err, and the scale multiplies them: with fixed weights their noise alone would shrink it. The
            # weights' own change with the scale makes it total least squares, which has no such bias.
            white[:, 0] += ((more - less) / (2 * small) @ error).reshape(-1)
        return white, (whitener @ error).reshape(-1)

    def _turn_rows(self, k: int, head: int, width: int) -> tuple[FloatArray, FloatArray]:
        """R_k+1 = R_k ΔR(bias)."""
        delta = self._deltas[k]
        predicted = delta.rotation @ so3_exp(delta.rotation_jacobian @ self._bias[3:])
        error = so3_log(predicted.T @ self._rotations[k].T @ self._rotations[k + 1])
        jacobian = np.zeros((3, width))
        jacobian[:, 4:7] = -delta.rotation_jacobian
        at = head + 6 * k
        jacobian[:, at + 3 : at + 6] = -self._rotations[k + 1].T @ self._rotations[k]
        jacobian[:, at + 9 : at + 12] = np.eye(3)
        weight = 1.0 / (self._sigmas.gyroscope * np.sqrt(delta.times[-1]))
        return weight * jacobian, weight * error

    def _prior_rows(self, head: int, width: int) -> tuple[FloatArray, FloatArray]:
        """Biases near zero, attitudes near what the images say."""
        sigmas, count = self._sigmas, self._count
        jacobian, error = np.zeros((6 + 3 * count, width)), np.zeros(6 + 3 * count)
        bias_weight = 1.0 / np.repeat([sigmas.accel_bias, sigmas.gyro_bias], 3)
        jacobian[np.arange(6), 1 + np.arange(6)] = bias_weight
        error[:6] = bias_weight * self._bias
        columns = head + 3 + 6 * np.arange(count)[:, None] + np.arange(3)
        jacobian[6 + np.arange(3 * count), columns.reshape(-1)] = 1.0 / sigmas.rotation
        turned = so3_log(np.swapaxes(self._visual_rotations, 1, 2) @ self._rotations)
        error[6:] = turned.reshape(-1) / sigmas.rotation
        return jacobian, error

    def _move(self, step: FloatArray, basis: FloatArray, head: int, gravity_is_free: bool) -> None:
        self._scale += float(step[0])
        self._bias = self._bias + step[1:7]
        self.gravity = self.gravity + basis @ step[7:head]
        if not gravity_is_free:
            self.gravity *= GRAVITY / np.linalg.norm(self.gravity)
        each = step[head:].reshape(self._count, 6)
        self._velocities = self._velocities + each[:, :3]
        self._rotations = self._rotations @ so3_exp(each[:, 3:])

    def _whiteners(self, t: FloatArray, scales: FloatArray) -> FloatArray:
        """Return W (S, M + 1, M + 1) with Wᵀ W the inverse covariance of Δp at M times and of Δv at the last, one axis.

        White noise of the accelerometer makes Δp and Δv integrals of one random walk; a frame and its keyframe err each by the
        position's sigma, so that the keyframe's error is common to all.
        """
        sigmas, frames = self._sigmas, len(t)
        early, late = np.minimum(t[:, None], t), np.maximum(t[:, None], t)
        covariance = np.empty((frames + 1, frames + 1))
        covariance[:frames, :frames] = early**2 * late / 2 - early**3 / 6
        covariance[:frames, frames] = covariance[frames, :frames] = t**2 / 2
        covariance[frames, frames] = t[-1]
        covariance *= sigmas.accelerometer**2
        of_scales = np.tile(covariance, (len(scales), 1, 1))
        of_scales[:, :frames, :frames] += (sigmas.position * scales[:, None, None]) ** 2 * (np.eye(frames) + 1.0)
        result: FloatArray = np.linalg.inv(np.linalg.cholesky(of_scales))
        return result


def _deltas(measurements: list[gtsam.PreintegratedCombinedMeasurements]) -> Deltas:
    """Return the preintegrated motion of each frame at zero bias, with Jacobians by differences: GTSAM keeps its own."""
    steps = np.concatenate([1e-3 * np.eye(6)[:3], 1e-4 * np.eye(6)[3:]])
    size = steps.sum(axis=1)
    base = [_motion(pim, np.zeros(6)) for pim in measurements]
    moved = [[_motion(pim, step) for step in steps] for pim in measurements]
    positions, velocities = (np.stack([motion[i] for motion in base]) for i in (0, 1))
    position_jacobian, velocity_jacobian = (
        np.stack([_slopes(b[i], [m[i] for m in row], size) for b, row in zip(base, moved, strict=True)]) for i in (0, 1)
    )
    turn = np.stack([so3_log(base[-1][2].T @ moved[-1][axis][2]) / size[axis] for axis in (3, 4, 5)], axis=1)
    times = np.array([pim.deltaTij() for pim in measurements])
    return Deltas(times, positions, velocities, position_jacobian, velocity_jacobian, base[-1][2], turn)


def _slopes(value: FloatArray, moved: list[FloatArray], steps: FloatArray) -> FloatArray:
    """Return the differences to a value (3,) of what it became (6 of them), over the steps (6,), as columns (3, 6)."""
    result: FloatArray = (np.stack(moved, axis=-1) - value[:, None]) / steps
    return result


def _motion(pim: gtsam.PreintegratedCombinedMeasurements, bias: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return Δp, Δv (3,), ΔR (3, 3) for a bias [accelerometer, gyro]: a prediction from the origin at rest, less the fall."""
    nav = pim.predict(gtsam.NavState(), gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))
    fall, t = np.array([0.0, 0.0, -GRAVITY]), pim.deltaTij()
    return nav.pose().translation() - 0.5 * t * t * fall, nav.velocity() - t * fall, nav.pose().rotation().matrix()


def _tangent_basis(direction: FloatArray) -> FloatArray:
    """Return two unit columns (3, 2) perpendicular to a direction."""
    unit = direction / np.linalg.norm(direction)
    first = np.cross(unit, np.eye(3)[int(np.argmin(np.abs(unit)))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(unit, first)], axis=1)
