"""Least squares over one camera and the pose of the board in each view: Levenberg–Marquardt on the reduced camera system.

Each view's pose is eliminated (Schur complement), so that a step costs one (P, P) system however many views there are, and what
one view says about the camera is at hand for leave-one-out and covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vli_calibration.lens import Lens
from vli_common.arrays import FloatArray, IntArray

_ITERATIONS = 60
_CONVERGED = 1e-9
_DAMPING = 1e-3
_DAMPING_MOST = 1e10


@dataclass(frozen=True, slots=True)
class Observation:
    """Corners of one view.

    Args:
        points: (K, 3) in the board frame.
        pixels: (K, 2) raw.
        weights: (K,) of the squared residuals; 0 leaves a corner out.
    """

    points: FloatArray
    pixels: FloatArray
    weights: FloatArray


@dataclass(frozen=True, slots=True)
class BundleState:
    """An estimate: parameters (P,) of the lens, and the poses (V, 6), rotation vectors and translations of T_cam_board."""

    parameters: FloatArray
    poses: FloatArray


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """The normal equations of one view with its pose eliminated.

    Args:
        reduced: (P, P) what the view says about the parameters once its pose is free.
        gradient: (P,) of the reduced problem.
        pose_inverse: (6, 6) inverse of the (damped) pose block.
        coupling: (6, P) block between pose and parameters.
        pose_gradient: (6,).
        cost: weighted sum of squared residuals.
    """

    reduced: FloatArray
    gradient: FloatArray
    pose_inverse: FloatArray
    coupling: FloatArray
    pose_gradient: FloatArray
    cost: float

    def pose_step(self, parameter_step: FloatArray) -> FloatArray:
        """Return the step (6,) of the pose that goes with a step of the parameters."""
        step: FloatArray = -self.pose_inverse @ (self.pose_gradient + self.coupling @ parameter_step)
        return step


def residuals(lens: Lens, state: BundleState, observations: Sequence[Observation]) -> list[FloatArray]:
    """Return projected minus seen pixels (K, 2) of each view."""
    return [
        lens.project(seen.points, pose, state.parameters)[0] - seen.pixels
        for seen, pose in zip(observations, state.poses, strict=True)
    ]


def normal_equations(
    lens: Lens, parameters: FloatArray, pose: FloatArray, seen: Observation, damping: float = 0.0
) -> NormalEquations:
    """Linearise one view and eliminate its pose.

    Args:
        damping: Marquardt's, relative to the diagonal of the pose block.
    """
    pixels, by_pose, by_parameters = lens.project(seen.points, pose, parameters)
    root = np.sqrt(np.repeat(seen.weights, 2))
    error = (pixels - seen.pixels).ravel() * root
    by_pose, by_parameters = by_pose * root[:, None], by_parameters * root[:, None]
    block = by_pose.T @ by_pose
    coupling = by_pose.T @ by_parameters
    inverse = _inverse(block + np.diag(damping * block.diagonal()))
    pose_gradient = by_pose.T @ error
    return NormalEquations(
        by_parameters.T @ by_parameters - coupling.T @ inverse @ coupling,
        by_parameters.T @ error - coupling.T @ inverse @ pose_gradient,
        inverse,
        coupling,
        pose_gradient,
        float(error @ error),
    )


def _inverse(block: FloatArray) -> FloatArray:
    try:
        return np.asarray(np.linalg.inv(block), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(block), dtype=np.float64)


def solve(
    lens: Lens,
    start: BundleState,
    observations: Sequence[Observation],
    fixed: Sequence[int] = (),
    iterations: int = _ITERATIONS,
) -> BundleState:
    """Return the least-squares estimate from a start near enough.

    Args:
        fixed: indices of parameters to hold (a start far off is brought near with the distortion held first).
    """
    free = np.setdiff1d(np.arange(len(start.parameters)), np.asarray(fixed, dtype=np.int64))
    state, damping = start, _DAMPING
    cost = _cost(lens, state, observations)
    for _ in range(iterations):
        trial, damping, trial_cost = _improve(lens, state, observations, free, damping, cost)
        if trial is None:
            break
        gain = (cost - trial_cost) / max(cost, 1e-30)
        state, cost = trial, trial_cost
        if gain < _CONVERGED:
            break
    return state


def _improve(
    lens: Lens, state: BundleState, observations: Sequence[Observation], free: IntArray, damping: float, cost: float
) -> tuple[BundleState | None, float, float]:
    """Return the next estimate, damping and cost; None where no step lowers the cost."""
    while damping < _DAMPING_MOST:
        views = [
            normal_equations(lens, state.parameters, pose, seen, damping)
            for seen, pose in zip(observations, state.poses, strict=True)
        ]
        step = np.zeros(len(state.parameters))
        reduced = sum((view.reduced for view in views), np.zeros((len(step), len(step))))[np.ix_(free, free)]
        gradient = sum((view.gradient for view in views), np.zeros(len(step)))[free]
        scale = np.sqrt(np.maximum(reduced.diagonal(), 1e-30))
        system = reduced / np.outer(scale, scale) + damping * np.eye(len(free))
        step[free] = -np.linalg.lstsq(system, gradient / scale, rcond=None)[0] / scale
        poses = state.poses + np.array([view.pose_step(step) for view in views])
        trial = BundleState(state.parameters + step, poses)
        trial_cost = _cost(lens, trial, observations)
        if trial_cost <= cost:
            return trial, max(damping / 10, 1e-12), trial_cost
        damping *= 10
    return None, damping, cost


def _cost(lens: Lens, state: BundleState, observations: Sequence[Observation]) -> float:
    errors = residuals(lens, state, observations)
    total = sum(float((seen.weights[:, None] * error**2).sum()) for seen, error in zip(observations, errors, strict=True))
    return total if np.isfinite(total) and (state.parameters[:2] > 0).all() and (state.poses[:, 5] > 0).all() else np.inf
