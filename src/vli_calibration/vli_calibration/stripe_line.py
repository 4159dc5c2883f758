"""The straight line that the stripe on a flat surface is: in bearings, a great circle, whatever the lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vli_common.arrays import BoolArray, FloatArray, IntArray
from vli_common.camera import CameraModel

_TRIALS = 200
_REFINEMENTS = 10
_OUTLIER_SIGMAS = 3.5
_LEAST_TOLERANCE_PX = 0.5
_SEED = 5


@dataclass(frozen=True, slots=True)
class StripeLine:
    """A line fitted to points of a stripe.

    Args:
        normal: (3,) unit, of the plane through the camera's centre that holds the line.
        residuals_px: (N,) signed distances of all points, pixels at the image centre's scale.
        inliers: (N,) the points that lie on it.
        scatter_px: robust standard deviation of the inliers about it.
    """

    normal: FloatArray
    residuals_px: FloatArray
    inliers: BoolArray
    scatter_px: float

    @property
    def tolerance_px(self) -> float:
        """How far from the line a point of it may be."""
        return max(_OUTLIER_SIGMAS * self.scatter_px, _LEAST_TOLERANCE_PX)


def bearings(camera: CameraModel, pixels: FloatArray) -> FloatArray:
    """Return unit viewing directions (N, 3) of raw pixels (N, 2); NaN where the lens model has none."""
    rays = np.column_stack([camera.unproject(pixels), np.ones(len(pixels))])
    result: FloatArray = rays / np.linalg.norm(rays, axis=1)[:, None]
    return result


def fit_stripe_line(
    camera: CameraModel, pixels: FloatArray, sure: BoolArray | None = None, tolerance_px: float = 2.0
) -> StripeLine | None:
    """Return the great circle that most points lie on (RANSAC, then trimmed least squares), None where there is none.

    Args:
        camera: its lens is taken out.
        pixels: (N, 2) raw.
        sure: (N,) points that the search starts from; others only join their line. All where None.
        tolerance_px: of the search; the refinement finds the scatter of the points itself.
    """
    directions = bearings(camera, pixels)
    valid = np.all(np.isfinite(directions), axis=1)
    start = valid if sure is None else valid & sure
    if start.sum() < 3:
        return None
    directions = np.where(valid[:, None], directions, 0.0)
    inliers = start & _largest_consensus(directions, np.flatnonzero(start), tolerance_px / camera.focal_px)
    tolerance: float | None = None
    line: StripeLine | None = None
    for candidates in (start, valid):
        line = _refined(directions, candidates, inliers, camera.focal_px, tolerance)
        if line is None:
            return None
        # What joins the sure points has to keep to their scatter, else it would bend the line to itself.
        inliers, tolerance = line.inliers, line.tolerance_px
    return line


def _refined(
    directions: FloatArray, candidates: BoolArray, inliers: BoolArray, focal_px: float, tolerance: float | None
) -> StripeLine | None:
    """Return the trimmed least-squares line of the candidates (N,), None where fewer than three stay."""
    normal, residuals, scatter = np.zeros(3), np.full(len(directions), np.inf), 0.0
    for _ in range(_REFINEMENTS):
        if inliers.sum() < 3:
            return None
        normal = np.linalg.svd(directions[inliers], full_matrices=False)[2][2]
        residuals = np.where(np.any(directions != 0, axis=1), directions @ normal * focal_px, np.inf)
        scatter = 1.4826 * float(np.median(np.abs(residuals[inliers])))
        limit = max(_OUTLIER_SIGMAS * scatter, _LEAST_TOLERANCE_PX) if tolerance is None else tolerance
        previous, inliers = inliers, candidates & (np.abs(residuals) <= limit)
        if (inliers == previous).all():
            break
    return StripeLine(normal, residuals, inliers, scatter)


def _largest_consensus(directions: FloatArray, candidates: IntArray, tolerance: float) -> BoolArray:
    """Return which directions (N, 3) lie within ``tolerance`` radians of the best great circle through two of them."""
    pairs = np.random.default_rng(_SEED).choice(candidates, (_TRIALS, 2))
    normals = np.cross(directions[pairs[:, 0]], directions[pairs[:, 1]])
    length = np.linalg.norm(normals, axis=1)
    # Two neighbours tell no direction.
    apart = length > 5 * tolerance
    normals = normals[apart] / length[apart][:, None]
    if not len(normals):
        return np.zeros(len(directions), np.bool_)
    near = np.abs(directions[candidates] @ normals.T) <= tolerance
    consensus = np.zeros(len(directions), np.bool_)
    consensus[candidates[near[:, int(near.sum(axis=0).argmax())]]] = True
    return consensus
