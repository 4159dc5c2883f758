"""Leave one view out: what the others predict of it, and how much the camera depends on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vli_calibration.bundle import BundleState, Observation, normal_equations, residuals, solve
from vli_calibration.lens import Lens
from vli_common.arrays import FloatArray

_POSE_ITERATIONS = 15


@dataclass(frozen=True, slots=True)
class LeaveOneOut:
    """Cameras of all views but one.

    Args:
        parameters: (V, P) estimate without each view.
        rms_px: (V,) RMS of a view's weighted corners under the camera of the others, its pose being fitted.
        information_inverse: (P, P) inverse of the reduced normal matrix of all views.
        jackknife_variance: (P,) of the parameters.
    """

    parameters: FloatArray
    rms_px: FloatArray
    information_inverse: FloatArray
    jackknife_variance: FloatArray


def leave_one_out(lens: Lens, state: BundleState, observations: Sequence[Observation]) -> LeaveOneOut:
    """Return the cameras without each view, one Newton step from the common optimum, and how they do on that view.

    Weights are the fit's own: a corner it left out does not count here either.
    """
    views = [normal_equations(lens, state.parameters, pose, seen) for seen, pose in zip(observations, state.poses, strict=True)]
    total = np.sum([view.reduced for view in views], axis=0)
    without = np.array([state.parameters + scaled_inverse(total - view.reduced) @ view.gradient for view in views])
    count = len(views)
    deviation = without - without.mean(axis=0)
    return LeaveOneOut(
        without,
        np.array(
            [
                view_rms(lens, parameters, pose, seen)
                for parameters, pose, seen in zip(without, state.poses, observations, strict=True)
            ]
        ),
        scaled_inverse(total),
        (count - 1) / count * (deviation**2).sum(axis=0),
    )


def view_rms(lens: Lens, parameters: FloatArray, pose: FloatArray, seen: Observation) -> float:
    """Return the weighted RMS of a view's residuals under a given camera, pixels, its pose (6,) being refined."""
    state = solve(lens, BundleState(parameters, pose[None]), [seen], range(len(parameters)), _POSE_ITERATIONS)
    squared = (residuals(lens, state, [seen])[0] ** 2).sum(axis=1)
    return float(np.sqrt((seen.weights * squared).sum() / seen.weights.sum()))


def scaled_inverse(matrix: FloatArray) -> FloatArray:
    """Return the pseudo-inverse of a normal matrix whose parameters differ in unit by orders of magnitude."""
    scale = np.sqrt(np.maximum(matrix.diagonal(), 1e-30))
    inverse: FloatArray = np.linalg.pinv(matrix / np.outer(scale, scale), rcond=1e-13, hermitian=True) / np.outer(scale, scale)
    return inverse
