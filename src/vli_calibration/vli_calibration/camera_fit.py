"""One camera from many views of a board: robust, with whole views left out where they do not belong, and what it is worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from vli_calibration.board_pose import pose_matrix
from vli_calibration.bundle import BundleState, Observation, residuals, solve
from vli_calibration.camera_start import starting_state
from vli_calibration.lens import LENSES, Lens
from vli_calibration.loo import LeaveOneOut, leave_one_out
from vli_calibration.robust import kept_corners, view_weights
from vli_calibration.targets import Target
from vli_calibration.types import Detection, Rejection
from vli_common.arrays import BoolArray, FloatArray
from vli_common.camera import CameraModel
from vli_common.errors import InputError

LEAST_VIEWS = 5
"""Fewer leave nothing to test the fit with."""
PARALLEL_DEG = 5.0
_LEAST_CORNERS = 8
_LEAST_SHARE = 0.4
_REJECTIONS = 12
_OUTLYING = 3.5
_LEAST_LOG_SPREAD = 0.4
_CONFIDENCE = 0.95
_FOCAL_UNKNOWN = 0.10


@dataclass(frozen=True, slots=True)
class View:
    """The corners found in one image."""

    name: str
    detection: Detection


@dataclass(frozen=True, slots=True)
class FittedView:
    """One view after the fit.

    Args:
        name: of the image.
        detection: all corners that were found.
        T_cam_board: (4, 4).
        residuals: (K, 2) projected minus seen, pixels, of all corners.
        kept: (K,) corners that the fit rests on.
        loo_rms_px: RMS of the kept corners with the camera of all other views, the pose being fitted.
    """

    name: str
    detection: Detection
    T_cam_board: FloatArray
    residuals: FloatArray
    kept: BoolArray
    loo_rms_px: float

    @property
    def rms_px(self) -> float:
        """RMS length of the kept residuals."""
        return rms(self.residuals[self.kept])


@dataclass(frozen=True, slots=True)
class CameraFit:
    """A camera, the views it rests on, and how well the parameters are known.

    Args:
        camera: the estimate.
        model: name in :data:`vli_calibration.lens.LENSES`.
        views: those that were used, in the order given.
        rejected: views that were not, with reasons.
        parameters: (P,) fx fy cx cy and distortion.
        covariance: (P, P) of the parameters, from the residuals' scatter.
        sigma: (P,) standard deviations: the larger of that and of the jackknife over whole views.
        rms_px: RMS length of all kept residuals.
        loo: leave-one-view-out estimates of the used views.
    """

    camera: CameraModel
    model: str
    views: tuple[FittedView, ...]
    rejected: tuple[Rejection, ...]
    parameters: FloatArray
    covariance: FloatArray
    sigma: FloatArray
    rms_px: float
    loo: LeaveOneOut

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return LENSES[self.model].parameters

    @property
    def T_cam_board(self) -> dict[str, FloatArray]:  # noqa: N802 (the field's notation)
        """Pose (4, 4) of the board by name of the view."""
        return {view.name: view.T_cam_board for view in self.views}

    @property
    def corners_used(self) -> int:
        """Corners that the fit rests on."""
        return int(sum(view.kept.sum() for view in self.views))

    @property
    def corners_total(self) -> int:
        """Corners found in the views that were used."""
        return sum(len(view.detection) for view in self.views)

    @property
    def loo_rms_px(self) -> float:
        """RMS over the views of their leave-one-out errors."""
        return float(np.sqrt(np.mean([view.loo_rms_px**2 for view in self.views])))

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """The 95 % interval of each parameter; Student's t, the views being the samples."""
        reach = stats.t.ppf(0.5 + _CONFIDENCE / 2, len(self.views) - 1) * self.sigma
        low, high = self.parameters - reach, self.parameters + reach
        return {name: (float(a), float(b)) for name, a, b in zip(self.names, low, high, strict=True)}


@dataclass(slots=True)
class _Problem:
    """The views still in play; ``kept`` and ``weights`` follow them."""

    lens: Lens
    views: list[View]
    observations: list[Observation]
    state: BundleState
    kept: list[BoolArray]
    weights: FloatArray

    def without(self, index: int) -> _Problem:
        """Return the problem without one of its views."""
        rest = [i for i in range(len(self.views)) if i != index]
        state = BundleState(self.state.parameters, self.state.poses[rest])
        return _Problem(
            self.lens,
            [self.views[i] for i in rest],
            [self.observations[i] for i in rest],
            state,
            [self.kept[i] for i in rest],
            self.weights[rest],
        )

    def weighted(self) -> list[Observation]:
        """Return the observations with their weights, zero where a corner was left out."""
        return [
            Observation(seen.points, seen.pixels, weight * kept)
            for seen, kept, weight in zip(self.observations, self.kept, self.weights, strict=True)
        ]

    def errors(self) -> list[FloatArray]:
        """Return the residuals (n, 2) of each view in pixels."""
        return residuals(self.lens, self.state, self.observations)


def fit_camera(views: Sequence[View], target: Target, resolution: tuple[int, int], model: str) -> CameraFit:
    """Fit one lens model.

    Args:
        views: corners by image.
        target: whose points they are.
        resolution: width and height, pixels.
        model: name in :data:`vli_calibration.lens.LENSES`.

    Raises:
        InputError: too few views, all of them parallel, or nothing that fits.
    """
    lens = LENSES[model]
    rejected = [_few_corners(view) for view in views if len(view.detection) < _LEAST_CORNERS]
    usable = [view for view in views if len(view.detection) >= _LEAST_CORNERS]
    _check_count(usable, rejected)
    observations = [
        Observation(target.points[view.detection.ids], view.detection.pixels, np.ones(len(view.detection))) for view in usable
    ]
    state = starting_state(lens, observations, resolution)
    if state is None:
        raise InputError(
            f"no camera of model '{model}' sees the board '{target.spec}' like this; "
            "check that --target describes the printed one"
        )
    everything = [np.ones(len(view.detection), dtype=bool) for view in usable]
    problem = _Problem(lens, usable, observations, state, everything, np.ones(len(usable)))
    _refine(problem)
    _check_tilts(problem)
    for _ in range(len(usable)):
        left_out = leave_one_out(lens, problem.state, problem.weighted())
        worst = _worst_view(problem, left_out)
        if worst is None:
            break
        index, reason = worst
        rejected.append(Rejection(problem.views[index].name, reason))
        problem = problem.without(index)
        _check_count(problem.views, rejected)
        _refine(problem)
    _check_tilts(problem)
    return _result(problem, left_out, rejected, model, resolution, target)


def rms(error: FloatArray) -> float:
    """Return the RMS length of residuals (N, 2)."""
    return float(np.sqrt((error**2).sum(axis=1).mean())) if len(error) else 0.0


def tilt_span_deg(T_cam_board: Sequence[FloatArray]) -> float:
    """Return the largest angle between the normals of two boards, degrees."""
    normals = np.array([T[:3, 2] for T in T_cam_board])
    return float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1))))


def _refine(problem: _Problem) -> None:
    """Alternate between the fit and the choice of corners until the choice rests."""
    for _ in range(_REJECTIONS):
        errors = problem.errors()
        kept = kept_corners(errors)
        problem.weights = view_weights(errors, kept)
        same = all((old == new).all() for old, new in zip(problem.kept, kept, strict=True))
        problem.kept = kept
        problem.state = solve(problem.lens, problem.state, problem.weighted())
        if same:
            break


def _worst_view(problem: _Problem, left_out: LeaveOneOut) -> tuple[int, str] | None:
    """Return the view to reject next and why, or None where all belong.

    A view belongs while its leave-one-out error is of the others' kind: its logarithm within 3.5 robust standard deviations of
    their median.
    """
    for index, (view, kept) in enumerate(zip(problem.views, problem.kept, strict=True)):
        if kept.sum() < max(_LEAST_CORNERS, _LEAST_SHARE * len(kept)):
            return index, f"only {kept.sum()} of {len(view.detection)} corners fit the board"
    logs = np.log(np.maximum(left_out.rms_px, 1e-6))
    centre = np.median(logs)
    spread = max(float(stats.median_abs_deviation(logs, scale="normal")), _LEAST_LOG_SPREAD)
    index = int(np.argmax(logs))
    if logs[index] - centre <= _OUTLYING * spread:
        return None
    return index, (
        f"{left_out.rms_px[index]:.2f} px off what the other views predict, {np.exp(logs[index] - centre):.1f} times as much as "
        "the middle one"
    )


def _few_corners(view: View) -> Rejection:
    return Rejection(view.name, f"only {len(view.detection)} corners found, expected {_LEAST_CORNERS} or more")


def _check_count(views: Sequence[View], rejected: Sequence[Rejection]) -> None:
    if len(views) < LEAST_VIEWS:
        lost = f" ({len(rejected)} rejected: {rejected[-1].name} is {rejected[-1].reason})" if rejected else ""
        raise InputError(
            f"the board is found in '{len(views)}' views{lost}, expected {LEAST_VIEWS} or more, better 20, "
            "at different tilts and distances"
        )


def _check_tilts(problem: _Problem) -> None:
    span = tilt_span_deg([pose_matrix(pose) for pose in problem.state.poses])
    if span < PARALLEL_DEG:
        raise InputError(
            f"all {len(problem.views)} views are parallel (tilts within '{span:.1f}' degrees), "
            "which leaves the focal length open; take views tilted by 20 to 45 degrees about both axes"
        )


def _result(
    problem: _Problem,
    left_out: LeaveOneOut,
    rejected: list[Rejection],
    model: str,
    resolution: tuple[int, int],
    target: Target,
) -> CameraFit:
    errors = problem.errors()
    kept_errors = np.vstack([error[kept] for error, kept in zip(errors, problem.kept, strict=True)])
    freedom = max(kept_errors.size - 6 * len(errors) - len(problem.state.parameters), 1)
    cost = sum(float((seen.weights[:, None] * error**2).sum()) for seen, error in zip(problem.weighted(), errors, strict=True))
    covariance = cost / freedom * left_out.information_inverse
    sigma = np.sqrt(np.maximum(covariance.diagonal(), left_out.jackknife_variance))
    focal = problem.state.parameters[:2]
    if (sigma[:2] > _FOCAL_UNKNOWN * focal).any():
        raise InputError(
            f"the views do not determine the focal length ('{focal[0]:.0f}' px to {100 * sigma[0] / focal[0]:.0f} %); "
            "take views tilted by 20 to 45 degrees about both axes, near and far"
        )
    fitted = tuple(
        FittedView(view.name, view.detection, pose_matrix(pose), error, kept, float(loo))
        for view, pose, error, kept, loo in zip(
            problem.views, problem.state.poses, errors, problem.kept, left_out.rms_px, strict=True
        )
    )
    camera = problem.lens.camera(problem.state.parameters, resolution)
    return CameraFit(
        camera, model, fitted, tuple(rejected), problem.state.parameters, covariance, sigma, rms(kept_errors), left_out
    )
