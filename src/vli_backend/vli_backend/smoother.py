"""The window's optimiser: GTSAM's fixed-lag smoother over keyframe poses, velocities and IMU biases.

IMU factors and the marginal prior live in the smoother. Landmarks, laser depths and map constraints reach it condensed
(:class:`vli_backend.condense.Quadratic`): one linear container over the window's poses, re-linearised and replaced at every
iteration. What leaves with the oldest keyframe is handed over separately at the end, so that the smoother marginalises it once.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from vli_backend.condense import Quadratic
from vli_common.arrays import FloatArray, IntArray
from vli_common.errors import VliError

_UNMEASURED_WALK = (1e-2, 1e-3)
"""Bias walk across a gap without IMU, accelerometer m/s³/√Hz and gyro rad/s²/√Hz: loose, yet not singular."""

_UNMEASURED_VELOCITY = 0.1
"""Sigma of the velocity at a keyframe without IMU, m/s: a hand in a confined space is slower."""


_WEAK = (0.1, 0.01, 0.1, 0.1, 0.01)
"""Sigmas of a keyframe that the solver fails on: rad, m, m/s, m/s² and rad/s of the biases. Any measurement says more."""

_STILL = (1e-4, 3e-6)
"""rad, m: how still a scanner at rest stands from keyframe to keyframe. Features alone leave ten times that, which adds up."""


class SmootherError(VliError):
    """The optimiser failed (indeterminate system); the window must be damped or started anew."""


@dataclass(frozen=True)
class KeyframeState:
    """Pose ``T_map_imu`` (4, 4), velocity (3,) in map, gyro and accelerometer bias (3,) each."""

    T_map_imu: FloatArray
    velocity: FloatArray
    gyro_bias: FloatArray
    accel_bias: FloatArray

    def nav_state(self) -> gtsam.NavState:
        """Return pose and velocity for IMU prediction."""
        return gtsam.NavState(gtsam.Pose3(self.T_map_imu), self.velocity)

    def bias(self) -> gtsam.imuBias.ConstantBias:
        """Return the bias as GTSAM has it (accelerometer first)."""
        return gtsam.imuBias.ConstantBias(self.accel_bias, self.gyro_bias)


@dataclass(frozen=True)
class StatePrior:
    """Sigmas of the first keyframe: rotation (3,) about imu_link, position, velocity, gyro bias, accelerometer bias."""

    rotation: FloatArray
    position: float
    velocity: float
    gyro_bias: float
    accel_bias: float


Condenser = Callable[[FloatArray], Quadratic]
"""Linearises the visual and map residuals at body poses (K, 4, 4)."""


class Smoother(Protocol):
    """What the back end needs of a fixed-lag smoother."""

    def start(self, state: KeyframeState, prior: StatePrior) -> None:
        """Begin a window with one keyframe."""

    def add_keyframe(self, state: KeyframeState, imu: gtsam.PreintegratedCombinedMeasurements | None, elapsed_s: float) -> None:
        """Append a keyframe with its first guess; without ``imu`` only the biases are linked to the last keyframe."""

    def hold_still(self) -> None:
        """Tie the newest keyframe to the one before: the scanner stood still between them."""

    def hold_scale(self, ratio: float, relative_sigma: float) -> None:
        """Tie the largest distance between two keyframes of the window to ``ratio`` times its present value; relative sigma."""

    def hold_newest(self) -> None:
        """Tie the newest keyframe weakly to where it is: what nothing determines no longer makes the solver fail."""

    def solve(self, condenser: Condenser, iterations: int) -> int:
        """Iterate to convergence; return the iterations used."""

    def marginalise_oldest(self, leaving: Condenser, staying: Condenser) -> None:
        """Remove the oldest keyframe; ``leaving`` is marginalised with it and holds all residuals that touch it."""

    def states(self) -> list[KeyframeState]:
        """Return all states in the window, oldest first."""

    def poses(self) -> FloatArray:
        """Return ``T_map_imu`` (K, 4, 4) of the window, oldest first."""

    def newest_covariance(self) -> FloatArray:
        """Return the (6, 6) marginal covariance of the newest pose, [ω, v] in imu_link."""


class GtsamSmoother:
    """:class:`Smoother` on ``gtsam.BatchFixedLagSmoother``.

    The smoother's clock is the keyframe index. A new keyframe is first given the index of its predecessor, so that nothing
    expires while the window iterates; its own index, set by :meth:`marginalise_oldest`, is what lets the oldest go.

    Args:
        keyframes: window length N; between :meth:`add_keyframe` and :meth:`marginalise_oldest` there may be N + 1.
        tolerance: largest pose step (rad, m) at which the iteration stops.
    """

    def __init__(self, keyframes: int, tolerance: tuple[float, float] = (3e-5, 2e-6)) -> None:
        self._keyframes = keyframes
        self._tolerance = tolerance
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(1)
        parameters.setlambdaInitial(1e-9)
        parameters.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
        self._smoother = gtsam.BatchFixedLagSmoother(keyframes - 0.5, parameters)
        self._first = 0
        self._count = 0
        self._container: gtsam.LinearContainerFactor | None = None
        self._estimate = gtsam.Values()
        # New keyframes, held back until a container is there: without residuals of their own their poses may be undetermined.
        self._new_factors, self._new_values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._new_stamps: Any = {}

    def start(self, state: KeyframeState, prior: StatePrior) -> None:
        """See :meth:`Smoother.start`."""
        values, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
        pose, bias = gtsam.Pose3(state.T_map_imu), state.bias()
        _insert(values, 0, pose, state)
        sigmas = np.concatenate([prior.rotation, np.full(3, prior.position)])
        graph.add(gtsam.PriorFactorPose3(X(0), pose, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
        graph.add(gtsam.PriorFactorVector(V(0), state.velocity, gtsam.noiseModel.Isotropic.Sigma(3, prior.velocity)))
        sigmas = np.repeat([prior.accel_bias, prior.gyro_bias], 3)
        graph.add(gtsam.PriorFactorConstantBias(B(0), bias, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
        self._count = 1
        self._update(graph, values, {X(0): 0.0, V(0): 0.0, B(0): 0.0})

    def add_keyframe(self, state: KeyframeState, imu: gtsam.PreintegratedCombinedMeasurements | None, elapsed_s: float) -> None:
        """See :meth:`Smoother.add_keyframe`."""
        last, new = self._first + self._count - 1, self._first + self._count
        graph = self._new_factors
        _insert(self._new_values, new, gtsam.Pose3(state.T_map_imu), state)
        _insert(self._estimate, new, gtsam.Pose3(state.T_map_imu), state)
        if imu is not None:
            graph.add(gtsam.CombinedImuFactor(X(last), V(last), X(new), V(new), B(last), B(new), imu))
        else:
            walk = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(_UNMEASURED_WALK, 3) * max(elapsed_s, 1e-3) ** 0.5)
            graph.add(gtsam.BetweenFactorConstantBias(B(last), B(new), gtsam.imuBias.ConstantBias(), walk))
            loose = gtsam.noiseModel.Isotropic.Sigma(3, _UNMEASURED_VELOCITY)
            graph.add(gtsam.PriorFactorVector(V(new), state.velocity, loose))
        self._new_stamps |= {key: float(last) for key in (X(last), V(last), B(last))}
        self._new_stamps |= {key: float(last) for key in (X(new), V(new), B(new))}
        self._count += 1

    def hold_still(self) -> None:
        """See :meth:`Smoother.hold_still`; robust, as a hand that seems still may creep."""
        newest = self._first + self._count - 1
        base = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(_STILL, 3))
        noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(2.0), base)
        self._new_factors.add(gtsam.BetweenFactorPose3(X(newest - 1), X(newest), gtsam.Pose3(), noise))

    def hold_scale(self, ratio: float, relative_sigma: float) -> None:
        """See :meth:`Smoother.hold_scale`."""
        positions = self.poses()[:, :3, 3]
        distances = np.linalg.norm(positions[:, None] - positions, axis=2)
        i, j = np.unravel_index(int(np.argmax(distances)), distances.shape)
        distance = ratio * float(distances[i, j])
        noise = gtsam.noiseModel.Isotropic.Sigma(1, relative_sigma * distance)
        self._new_factors.add(gtsam.RangeFactorPose3(X(self._first + i), X(self._first + j), distance, noise))

    def hold_newest(self) -> None:
        """See :meth:`Smoother.hold_newest`."""
        newest = self._first + self._count - 1
        rotation, position, velocity, accel_bias, gyro_bias = _WEAK
        values, noise = self._estimate, gtsam.noiseModel
        pose_noise = noise.Diagonal.Sigmas(np.repeat([rotation, position], 3))
        self._new_factors.add(gtsam.PriorFactorPose3(X(newest), values.atPose3(X(newest)), pose_noise))
        velocity_noise = noise.Isotropic.Sigma(3, velocity)
        self._new_factors.add(gtsam.PriorFactorVector(V(newest), values.atVector(V(newest)), velocity_noise))
        bias_noise = noise.Diagonal.Sigmas(np.repeat([accel_bias, gyro_bias], 3))
        self._new_factors.add(gtsam.PriorFactorConstantBias(B(newest), values.atConstantBias(B(newest)), bias_noise))

    def solve(self, condenser: Condenser, iterations: int) -> int:
        """See :meth:`Smoother.solve`."""
        poses = self.poses()
        for iteration in range(iterations):
            self._replace(self._to_container(condenser(poses)))
            moved = self.poses()
            step_m = float(np.abs(moved[:, :3, 3] - poses[:, :3, 3]).max())
            step_rad = float(np.abs(moved[:, :3, :3] - poses[:, :3, :3]).max())
            poses = moved
            if step_rad < self._tolerance[0] and step_m < self._tolerance[1]:
                return iteration + 1
        return iterations

    def marginalise_oldest(self, leaving: Condenser, staying: Condenser) -> None:
        """See :meth:`Smoother.marginalise_oldest`."""
        poses = self.poses()
        newest = self._first + self._count - 1
        stay = self._to_container(staying(poses), skip=1)
        graph = gtsam.NonlinearFactorGraph()
        graph.add(self._to_container(leaving(poses)))
        graph.add(stay)
        removed = [self._slot_of(self._container)] if self._container is not None else []
        time = float(self._first + self._keyframes)
        self._update(graph, gtsam.Values(), {X(newest): time, V(newest): time, B(newest): time}, removed)
        self._container = stay
        self._first += 1
        self._count -= 1

    def states(self) -> list[KeyframeState]:
        """See :meth:`Smoother.states`."""
        result = []
        for k in range(self._first, self._first + self._count):
            bias = self._estimate.atConstantBias(B(k))
            pose = self._estimate.atPose3(X(k)).matrix()
            result.append(KeyframeState(pose, self._estimate.atVector(V(k)), bias.gyroscope(), bias.accelerometer()))
        return result

    def newest_covariance(self) -> FloatArray:
        """See :meth:`Smoother.newest_covariance`."""
        order = gtsam.Ordering()
        keyframes = range(self._first, self._first + self._count)
        for k in keyframes:
            order.push_back(V(k))
            order.push_back(B(k))
            if k < keyframes[-1]:
                order.push_back(X(k))
        # Eliminated last, the pose is conditioned on nothing: its block of the square-root information is its marginal.
        order.push_back(X(keyframes[-1]))
        try:
            graph = self._smoother.getFactors().linearize(self._smoother.getLinearizationPoint())
            factors = graph.eliminateSequential(order)
            root = factors.at(factors.size() - 1).R()
        except RuntimeError as error:
            raise SmootherError(f"no covariance: {_first_line(error)}") from error
        return np.asarray(np.linalg.inv(root.T @ root))

    def poses(self) -> FloatArray:
        """See :meth:`Smoother.poses`."""
        return np.stack([self._estimate.atPose3(X(k)).matrix() for k in range(self._first, self._first + self._count)])

    def _to_container(self, quadratic: Quadratic, skip: int = 0) -> gtsam.LinearContainerFactor:
        """Return the quadratic, without its ``skip`` oldest poses, as one factor."""
        keys = [X(k) for k in range(self._first + skip, self._first + self._count)]
        h, g = quadratic.hessian[6 * skip :, 6 * skip :], -quadratic.gradient[6 * skip :]
        point = gtsam.Values()
        for key in keys:
            point.insert(key, self._estimate.atPose3(key))
        return gtsam.LinearContainerFactor(sum_of_small_factors(keys, h, g, quadratic.constant), point)

    def _replace(self, container: gtsam.LinearContainerFactor) -> None:
        self._new_factors.add(container)
        removed = [self._slot_of(self._container)] if self._container is not None else []
        added = self._new_factors, self._new_values, self._new_stamps
        # GTSAM takes them before it solves: after a failure they are in, and must not be added again.
        self._container = container
        self._new_factors, self._new_values, self._new_stamps = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}
        self._update(*added, removed)

    def _slot_of(self, factor: gtsam.NonlinearFactor) -> int:
        factors = self._smoother.getFactors()
        for slot in range(factors.size() - 1, -1, -1):
            if factors.exists(slot) and factors.at(slot) is factor:
                return slot
        raise SmootherError("a factor to be replaced is no longer in the smoother")

    def _update(
        self,
        graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        stamps: Any,
        removed: Sequence[int] = (),
    ) -> None:
        try:
            self._smoother.update(graph, values, stamps, list(removed))
            self._estimate = self._smoother.calculateEstimate()
        except (RuntimeError, ValueError) as error:
            raise SmootherError(_first_line(error)) from error


def sum_of_small_factors(keys: list[int], h: FloatArray, g: FloatArray, f: float) -> gtsam.HessianFactor:
    """Return the factor ½ δᵀ h δ − gᵀ δ + ½ f of any number of poses; h (6n, 6n), g (6n,).

    It is summed up from factors of three poses: from Python GTSAM takes no larger one.
    """
    blocks = gtsam.GaussianFactorGraph()
    for group in _cover(len(keys)):
        part = h[group.rows[:, None], group.rows] * group.carries
        blocks.push_back(_hessian([keys[i] for i in group.poses], part, g[group.rows] * group.carries_gradient, f))
        f = 0.0
    return gtsam.HessianFactor(blocks)


@dataclass(frozen=True)
class _Group:
    """Up to three poses: their (6n,) rows of the whole quadratic, and what of it they carry, (6n, 6n) and (6n,), 0 or 1."""

    poses: tuple[int, ...]
    rows: IntArray
    carries: FloatArray
    carries_gradient: FloatArray


@functools.cache
def _cover(count: int) -> tuple[_Group, ...]:
    """Return groups of ``count`` poses that hold every pair once."""
    missing = {(i, j) for i in range(count) for j in range(i, count)}
    groups = []
    while missing:
        group = max(itertools.combinations(range(count), min(count, 3)), key=lambda item: len(_pairs(item) & missing))
        fresh = _pairs(group) & missing
        missing -= fresh
        carried = np.array([[float((min(i, j), max(i, j)) in fresh) for j in group] for i in group])
        carries = np.kron(carried, np.ones((6, 6)))
        rows = (6 * np.array(group)[:, None] + np.arange(6)).ravel()
        groups.append(_Group(group, rows, carries, carries.diagonal().copy()))
    return tuple(groups)


def _pairs(group: tuple[int, ...]) -> set[tuple[int, int]]:
    return set(itertools.combinations_with_replacement(group, 2))


def _hessian(keys: list[int], h: FloatArray, g: FloatArray, f: float) -> gtsam.HessianFactor:
    """Return the factor ½ δᵀ h δ − gᵀ δ + ½ f of one to three poses."""
    a, b, c = slice(0, 6), slice(6, 12), slice(12, 18)
    if len(keys) == 1:
        return gtsam.HessianFactor(keys[0], h, g, f)
    if len(keys) == 2:
        return gtsam.HessianFactor(keys[0], keys[1], h[a, a], h[a, b], g[a], h[b, b], g[b], f)
    return gtsam.HessianFactor(
        keys[0], keys[1], keys[2], h[a, a], h[a, b], h[a, c], g[a], h[b, b], h[b, c], g[b], h[c, c], g[c], f
    )


def _insert(values: gtsam.Values, index: int, pose: gtsam.Pose3, state: KeyframeState) -> None:
    values.insert(X(index), pose)
    values.insert(V(index), state.velocity)
    values.insert(B(index), state.bias())


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
