"""Camera, boards and laser plane in one least-squares problem, every residual in units of its measured sigma.

Gauss–Newton; the pose of each view is eliminated from its own block of the normal equations (Schur complement), so that a view
comes down to one small system in the shared parameters. Those also serve the bootstrap.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from vli_calibration import laser_model as model
from vli_calibration.laser_model import LaserPlane
from vli_common.arrays import BoolArray, FloatArray, IntArray
from vli_common.camera import CameraModel
from vli_common.errors import InputError
from vli_common.geometry import inverse, so3_log

MORE_VIEWS = "take 10 or more images of the board with the stripe on it, tilted in several ways and at several distances"
"""What to do where a calibration of the plane fails."""

_ITERATIONS = 30
_ROUNDS = 6
_CONVERGED = 1e-7
_FIRST_DAMPING = 1e-4
OUTLIER_SIGMAS = 3.0
"""What lies further off, in measured sigmas, is left out."""
_LEAST_SIGMA_PX = 0.02
_LEAST_SCALE = 0.05
_LEAST_STRIPE_SIGMA_M = 1e-7

_Rows: TypeAlias = tuple[FloatArray, FloatArray, IntArray]
"""Jacobian (N, P) of whitened residuals, the residuals (N,), and the view of each (N,)."""


@dataclass(frozen=True)
class LaserView:
    """What one image tells of camera and laser plane.

    Args:
        name: of the image.
        points: (K, 3) corners in the board frame; none in an image that shows the stripe alone.
        pixels: (K, 2) the same, raw.
        stripe: (M, 2) raw pixels of the stripe; may be none.
        sigma_px: (M,) of those, across the stripe.
        correlation: number of neighbours along the stripe that err together: so many count as one.
        T_cam_board: (4, 4) first estimate; of the surface the stripe lies on, where no board shows.
        prior: (6,) sigmas of that estimate (rad, m) where it is a measurement of its own, from an arm; None otherwise.
    """

    name: str
    points: FloatArray
    pixels: FloatArray
    stripe: FloatArray
    sigma_px: FloatArray
    correlation: float
    T_cam_board: FloatArray
    prior: FloatArray | None = None


@dataclass(frozen=True)
class ReducedSystem:
    """Normal equations of one view in the shared parameters, its pose eliminated: ``hessian`` (P, P) and ``gradient`` (P,)."""

    hessian: FloatArray
    gradient: FloatArray


@dataclass(frozen=True)
class JointSolution:
    """The estimate, and what it rests on.

    Args:
        camera, plane: refined.
        poses: (V, 4, 4) T_cam_board of each view.
        corner_kept, stripe_kept: (ΣK,), (ΣM,) of all views in order.
        corner_sigma_px: measured standard deviation of a corner's coordinate.
        stripe_scale: measured spread of the stripe's residuals in units of their sigmas.
        systems: one for each view, at the solution; parameters as in ``free``.
        free: (C + 3,) shared parameters that were estimated; the last three are the plane's.
        iterations: Gauss–Newton steps of the last round.
        converged: the last step was below the tolerance.
    """

    camera: CameraModel
    plane: LaserPlane
    poses: FloatArray
    corner_kept: BoolArray
    stripe_kept: BoolArray
    corner_sigma_px: float
    stripe_scale: float
    systems: tuple[ReducedSystem, ...]
    free: BoolArray
    iterations: int
    converged: bool

    def distances(self, views: Sequence[LaserView]) -> list[FloatArray]:
        """Return the signed distance (M,) of every stripe point of each view from the plane, metres."""
        return [
            self.plane.distance(model.stripe_points(self.camera, T, view.stripe))
            for view, T in zip(views, self.poses, strict=True)
        ]


class JointProblem:
    """The problem for one set of views.

    Args:
        views: boards with stripes, boards alone, stripes alone.
        along_columns: True where the stripe's error is along the image columns.
        camera_sigmas: (C,) how well each parameter of the camera is known beforehand; zero holds it, infinity leaves it free.
    """

    def __init__(self, views: Sequence[LaserView], along_columns: bool, camera_sigmas: FloatArray) -> None:
        self.views = tuple(views)
        self._axis = 1 if along_columns else 0
        self._camera_sigmas = camera_sigmas
        self._corner_view = np.repeat(np.arange(len(views)), [len(view.points) for view in views])
        self._stripe_view = np.repeat(np.arange(len(views)), [len(view.stripe) for view in views])
        self._points = np.concatenate([view.points for view in views])
        self._pixels = np.concatenate([view.pixels for view in views])
        self._stripe = np.concatenate([view.stripe for view in views])
        self._sigma_px = np.concatenate([view.sigma_px for view in views])
        self._correlation = np.array([view.correlation for view in views])[self._stripe_view]
        # A stripe without a board has its pose to itself and fits too well to measure with.
        self._telling = np.array([view.prior is None for view in views])[self._stripe_view]

    def solve(self, camera: CameraModel, plane: LaserPlane) -> JointSolution:
        """Return the least-squares estimate; points and corners far beyond the measured sigmas are left out, found in rounds.

        Raises:
            InputError: the views do not determine the parameters.
        """
        self._prior_camera = model.camera_parameters(camera)
        state = self._measured(self._start(camera, plane))
        for _ in range(_ROUNDS):
            previous, state = state, self._measured(self._minimised(state))
            if _same_kept(previous, state):
                break
        return self._minimised(state)

    def corner_rms_px(self, state: JointSolution) -> float:
        """Return the RMS length of the kept corners' reprojection errors."""
        errors = model.corner_residuals(state.camera, state.poses[self._corner_view], self._points, self._pixels)
        return float(np.sqrt((errors[state.corner_kept] ** 2).sum(axis=1).mean()))

    def _start(self, camera: CameraModel, plane: LaserPlane) -> JointSolution:
        return JointSolution(
            camera=camera,
            plane=plane,
            poses=np.stack([view.T_cam_board for view in self.views]),
            corner_kept=np.ones(len(self._points), np.bool_),
            stripe_kept=np.ones(len(self._stripe), np.bool_),
            corner_sigma_px=1.0,
            stripe_scale=1.0,
            systems=(),
            free=np.append(self._camera_sigmas > 0, np.ones(model.PLANE_PARAMETERS, np.bool_)),
            iterations=0,
            converged=False,
        )

    def _minimised(self, state: JointSolution) -> JointSolution:
        """Return the estimate after Levenberg–Marquardt with what is kept now, and the reduced systems there."""
        damping, iterations, converged = 0.0, 0, False
        blocks, cost = self._blocks(state)
        for iterations in range(1, _ITERATIONS + 1):  # noqa: B007 (reported)
            trial = _moved(state, *_step(blocks, damping))
            trial_blocks, trial_cost = self._blocks(trial)
            converged = abs(cost - trial_cost) <= _CONVERGED * cost
            if trial_cost <= cost:
                state, blocks, cost, damping = trial, trial_blocks, trial_cost, 0.1 * damping
            else:
                damping = max(10 * damping, _FIRST_DAMPING)
            if converged:
                break
        systems = tuple(block.reduced() for block in blocks)
        return replace(state, systems=systems, iterations=iterations, converged=converged)

    def _measured(self, state: JointSolution) -> JointSolution:
        """Return the state with the sigmas that its residuals show, and with what lies beyond the limit left out."""
        corners = model.corner_residuals(state.camera, state.poses[self._corner_view], self._points, self._pixels)
        points = self._stripe_points(state)
        stripe = np.abs(state.plane.distance(points)) / self._sigmas(state, points)
        sigma = max(_robust_sigma(corners[state.corner_kept]), _LEAST_SIGMA_PX)
        scale = max(_robust_sigma(stripe[state.stripe_kept & self._telling]), _LEAST_SCALE)
        return replace(
            state,
            corner_sigma_px=sigma,
            stripe_scale=scale,
            corner_kept=np.all(np.abs(corners) <= OUTLIER_SIGMAS * sigma, axis=1),
            # Before the first solve, what an arm predicts is off by more than the stripe's own noise.
            stripe_kept=((stripe <= OUTLIER_SIGMAS * scale) | (~self._telling & (state.iterations == 0))) & (points[:, 2] > 0),
        )

    def _stripe_points(self, state: JointSolution) -> FloatArray:
        return model.stripe_points(state.camera, state.poses[self._stripe_view], self._stripe)

    def _sigmas(self, state: JointSolution, points: FloatArray) -> FloatArray:
        """Return the detector's sigma (M,) as a distance from the plane, metres."""
        poses = state.poses[self._stripe_view]
        sigmas = model.stripe_sigmas(state.camera, poses, points, self._sigma_px, state.plane, self._axis)
        return np.maximum(sigmas, _LEAST_STRIPE_SIGMA_M)

    def _blocks(self, state: JointSolution) -> tuple[list[_Block], float]:
        """Return the normal equations of each view in camera, plane and its own pose; the first one bears the camera's prior."""
        free, count = np.append(state.free, np.ones(6, np.bool_)), len(state.free) + 6
        rows, errors, owners = [], [], []
        for jacobian, error, owner in (self._corner_rows(state, count), self._stripe_rows(state), self._prior_rows(state, count)):
            rows.append(jacobian[:, free])
            errors.append(error)
            owners.append(owner)
        jacobian, error, owner = np.concatenate(rows), np.concatenate(errors), np.concatenate(owners)
        order = np.argsort(owner, kind="stable")
        bounds = np.searchsorted(owner[order], np.arange(len(self.views) + 1))
        blocks = []
        for start, stop in itertools.pairwise(bounds):
            mine, e = jacobian[order[start:stop]], error[order[start:stop]]
            blocks.append(_Block(mine.T @ mine, mine.T @ e))
        return blocks, float(error @ error)

    def _corner_rows(self, state: JointSolution, count: int) -> _Rows:
        kept = state.corner_kept
        view = self._corner_view[kept]
        by_camera, by_pose = model.corner_jacobians(state.camera, state.poses[view], self._points[kept])
        error = model.corner_residuals(state.camera, state.poses[view], self._points[kept], self._pixels[kept])
        none = np.zeros((*by_camera.shape[:2], model.PLANE_PARAMETERS))
        jacobian = np.concatenate([by_camera, none, by_pose], axis=2).reshape(-1, count)
        return jacobian / state.corner_sigma_px, error.ravel() / state.corner_sigma_px, np.repeat(view, 2)

    def _stripe_rows(self, state: JointSolution) -> _Rows:
        kept = state.stripe_kept
        view, points = self._stripe_view[kept], self._stripe_points(state)
        weight = 1 / (self._sigmas(state, points) * state.stripe_scale * np.sqrt(self._correlation))[kept]
        points = points[kept]
        jacobian = np.hstack(model.stripe_jacobians(state.camera, state.poses[view], points, state.plane))
        return jacobian * weight[:, None], state.plane.distance(points) * weight, view

    def _prior_rows(self, state: JointSolution, count: int) -> _Rows:
        """Return the rows of what is known beforehand: poses from an arm, and the camera's parameters."""
        rows, errors, owners = [np.empty((0, count))], [np.empty(0)], [np.empty(0, np.int64)]
        for index, view in enumerate(self.views):
            if view.prior is not None:
                step = inverse(view.T_cam_board) @ state.poses[index]
                rows.append(np.hstack([np.zeros((6, count - 6)), np.diag(1 / view.prior)]))
                errors.append(np.append(so3_log(step[:3, :3]), step[:3, 3]) / view.prior)
                owners.append(np.full(6, index))
        known = np.flatnonzero(np.isfinite(self._camera_sigmas) & (self._camera_sigmas > 0))
        moved = model.camera_parameters(state.camera) - self._prior_camera
        rows.append(np.eye(count)[known] / self._camera_sigmas[known, None])
        errors.append(moved[known] / self._camera_sigmas[known])
        owners.append(np.zeros(len(known), np.int64))
        return np.concatenate(rows), np.concatenate(errors), np.concatenate(owners)


@dataclass(frozen=True)
class _Block:
    """Normal equations of one view: shared parameters first, the six of its pose last."""

    hessian: FloatArray
    gradient: FloatArray

    def reduced(self, damping: float = 0.0) -> ReducedSystem:
        """Return what is left after the pose is eliminated."""
        gain = np.linalg.solve(_damped(self.hessian[-6:, -6:], damping), self.hessian[-6:]).T
        return ReducedSystem(
            self.hessian[:-6, :-6] - gain[:-6] @ self.hessian[-6:, :-6], self.gradient[:-6] - gain[:-6] @ self.gradient[-6:]
        )

    def pose_step(self, shared: FloatArray, damping: float) -> FloatArray:
        """Return the step (6,) of the pose that goes with a step of the shared parameters."""
        right: FloatArray = self.gradient[-6:] + self.hessian[-6:, :-6] @ shared
        step: FloatArray = np.asarray(np.linalg.solve(_damped(self.hessian[-6:, -6:], damping), -right), np.float64)
        return step


def solve_reduced(hessian: FloatArray, right: FloatArray) -> FloatArray:
    """Return the solution of H x = right, scaled by the diagonal first: focal lengths and radians are far apart in size.

    Raises:
        InputError: H is singular.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(hessian), np.finfo(np.float64).tiny))
    try:
        scaled = np.linalg.solve(hessian * np.outer(scale, scale), (right.T * scale).T)
    except np.linalg.LinAlgError:
        raise InputError(f"the views do not determine camera and laser plane; {MORE_VIEWS}") from None
    result: FloatArray = np.asarray((scaled.T * scale).T)
    return result


def _damped(hessian: FloatArray, damping: float) -> FloatArray:
    return hessian + damping * np.diag(np.diag(hessian))


def _step(blocks: Sequence[_Block], damping: float) -> tuple[FloatArray, list[FloatArray]]:
    systems = [block.reduced(damping) for block in blocks]
    hessian = _damped(np.sum([system.hessian for system in systems], axis=0), damping)
    shared = -solve_reduced(hessian, np.sum([system.gradient for system in systems], axis=0))
    return shared, [block.pose_step(shared, damping) for block in blocks]


def _moved(state: JointSolution, shared: FloatArray, steps: Sequence[FloatArray]) -> JointSolution:
    full = np.zeros(len(state.free))
    full[state.free] = shared
    camera = model.camera_parameters(state.camera) + full[: -model.PLANE_PARAMETERS]
    return replace(
        state,
        camera=model.with_parameters(state.camera, camera),
        plane=state.plane.moved(full[-model.PLANE_PARAMETERS :]),
        poses=np.stack([model.moved_pose(T, step) for T, step in zip(state.poses, steps, strict=True)]),
    )


def _robust_sigma(errors: FloatArray) -> float:
    return 1.4826 * float(np.median(np.abs(errors))) if errors.size else 0.0


def _same_kept(first: JointSolution, second: JointSolution) -> bool:
    return np.array_equal(first.corner_kept, second.corner_kept) and np.array_equal(first.stripe_kept, second.stripe_kept)
