"""A first estimate of a camera from nothing but the corners: several focal lengths are tried, the best one is refined."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vli_calibration.board_pose import starting_pose
from vli_calibration.bundle import BundleState, Observation, residuals, solve
from vli_calibration.lens import Lens
from vli_calibration.robust import axis_sigma, robust_weights
from vli_common.arrays import FloatArray

_FOCALS_OF_SIDE = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0)
"""Focal lengths to try over the longer side of the image: from 110° to 19° of view."""
_ROUGH_ITERATIONS = 6
_REWEIGHTINGS = 12
_SETTLED = 1e-3
_PROMISING = 3
_VIEWS = 12
"""Views for the search; the rest follows once a camera is there."""


def starting_state(lens: Lens, observations: Sequence[Observation], resolution: tuple[int, int]) -> BundleState | None:
    """Return an estimate robust enough to judge single corners by; None where no focal length puts the board before the camera.

    Args:
        observations: all corners of each view.
        resolution: width and height, pixels.
    """
    some = [observations[i] for i in np.unique(np.linspace(0, len(observations) - 1, _VIEWS).round().astype(int))]
    state = _search(lens, some, resolution)
    if state is None or len(some) == len(observations):
        return state
    everywhere = _with_poses(lens, state.parameters, observations, resolution)
    return _search(lens, observations, resolution) if everywhere is None else _settle(lens, everywhere, observations)


def _search(lens: Lens, observations: Sequence[Observation], resolution: tuple[int, int]) -> BundleState | None:
    """Return the estimate with the smallest median residual among those that the focal lengths lead to."""
    rough = [state for state in (_rough(lens, observations, resolution, f) for f in _FOCALS_OF_SIDE) if state is not None]
    rough.sort(key=lambda state: _spread(lens, state, observations))
    settled = [_settle(lens, state, observations) for state in rough[:_PROMISING]]
    return min(settled, key=lambda state: _spread(lens, state, observations), default=None)


def _with_poses(
    lens: Lens, parameters: FloatArray, observations: Sequence[Observation], resolution: tuple[int, int]
) -> BundleState | None:
    """Return the camera with a pose for every view; None where one has none."""
    camera = lens.camera(parameters, resolution)
    poses = [starting_pose(camera, seen.points, seen.pixels) for seen in observations]
    found = [pose for pose in poses if pose is not None]
    return BundleState(parameters, np.array(found)) if len(found) == len(poses) else None


def _rough(
    lens: Lens, observations: Sequence[Observation], resolution: tuple[int, int], focal_of_side: float
) -> BundleState | None:
    """Return poses and focal lengths from one guess; centre and the higher coefficients stay where they are."""
    width, height = resolution
    focal = focal_of_side * max(resolution)
    parameters = np.zeros(len(lens.parameters))
    parameters[:4] = focal, focal, (width - 1) / 2, (height - 1) / 2
    state = _with_poses(lens, parameters, observations, resolution)
    if state is None:
        return None
    held = [i for i, name in enumerate(lens.parameters) if name not in ("fx", "fy", "k1")]
    return solve(lens, state, _weighted(lens, state, observations), held, _ROUGH_ITERATIONS)


def _settle(lens: Lens, state: BundleState, observations: Sequence[Observation]) -> BundleState:
    """Iterate reweighted least squares until the residuals' median rests."""
    spread = _spread(lens, state, observations)
    for _ in range(_REWEIGHTINGS):
        state = solve(lens, state, _weighted(lens, state, observations), iterations=_ROUGH_ITERATIONS)
        before, spread = spread, _spread(lens, state, observations)
        if abs(before - spread) < _SETTLED * spread:
            break
    return state


def _weighted(lens: Lens, state: BundleState, observations: Sequence[Observation]) -> list[Observation]:
    errors = residuals(lens, state, observations)
    sigma = axis_sigma(np.linalg.norm(np.vstack(errors), axis=1))
    return [
        Observation(seen.points, seen.pixels, robust_weights(error, sigma))
        for seen, error in zip(observations, errors, strict=True)
    ]


def _spread(lens: Lens, state: BundleState, observations: Sequence[Observation]) -> float:
    lengths: FloatArray = np.linalg.norm(np.vstack(residuals(lens, state, observations)), axis=1)
    return axis_sigma(lengths)
