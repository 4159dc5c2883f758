"""Pose of the board in one image whose camera is known, with its disturbed corners left out."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vli_calibration.bundle import BundleState, Observation, residuals, solve
from vli_calibration.lens import lens_of
from vli_calibration.robust import kept_corners, robust_weights
from vli_common.arrays import BoolArray, FloatArray
from vli_common.camera import CameraModel

_LEAST_CORNERS = 6
_REWEIGHTINGS = 4


@dataclass(frozen=True, slots=True)
class BoardPose:
    """A board's pose, and how well it fits.

    Args:
        T_cam_board: (4, 4).
        kept: (K,) corners that the pose rests on.
        residuals: (K, 2) projected minus seen, pixels, of all corners.
    """

    T_cam_board: FloatArray
    kept: BoolArray
    residuals: FloatArray

    @property
    def rms_px(self) -> float:
        """RMS length of the kept residuals."""
        return float(np.sqrt((self.residuals[self.kept] ** 2).sum(axis=1).mean()))


def board_pose(camera: CameraModel, points: FloatArray, pixels: FloatArray) -> BoardPose | None:
    """Return the pose that fits the corners in pixels, robust against a few bad ones; None where there is none.

    Args:
        points: (K, 3) in the board frame, z = 0.
        pixels: (K, 2) raw.
    """
    start = starting_pose(camera, points, pixels)
    if start is None:
        return None
    lens, parameters = lens_of(camera)
    held = range(len(parameters))
    state = BundleState(parameters, start[None])
    kept = np.ones(len(points), dtype=bool)
    for _ in range(_REWEIGHTINGS):
        error = residuals(lens, state, [Observation(points, pixels, np.ones(len(points)))])[0]
        state = solve(lens, state, [Observation(points, pixels, robust_weights(error))], held)
    for _ in range(_REWEIGHTINGS):
        error = residuals(lens, state, [Observation(points, pixels, np.ones(len(points)))])[0]
        before, kept = kept, kept_corners([error])[0]
        if kept.sum() < _LEAST_CORNERS:
            return None
        state = solve(lens, state, [Observation(points, pixels, kept.astype(np.float64))], held)
        if (before == kept).all():
            break
    error = residuals(lens, state, [Observation(points, pixels, np.ones(len(points)))])[0]
    return BoardPose(pose_matrix(state.poses[0]), kept, error)


def starting_pose(camera: CameraModel, points: FloatArray, pixels: FloatArray) -> FloatArray | None:
    """Return a pose (6,), rotation vector and translation, from the homography of the board; None where it has none.

    Of the two poses that a plane seen from afar leaves open, the one with the smaller error in the image.
    """
    rays = camera.unproject(pixels)
    seen = np.isfinite(rays).all(axis=1)
    if seen.sum() < _LEAST_CORNERS:
        return None
    # The plane's own pose methods want its origin amid the points.
    centre = points[seen].mean(axis=0)
    try:
        count, turns, shifts, _ = cv2.solvePnPGeneric(points[seen] - centre, rays[seen], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:
        return None
    poses = [
        np.concatenate([turn.ravel(), shift.ravel() - cv2.Rodrigues(turn)[0] @ centre])
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    poses = [pose for pose in poses if np.isfinite(pose).all() and _in_front(pose, points)]
    return poses[0] if count and poses else None


def pose_matrix(pose: FloatArray) -> FloatArray:
    """Return T (4, 4) of a rotation vector and a translation (6,)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(pose[:3])[0], pose[3:]
    return T


def _in_front(pose: FloatArray, points: FloatArray) -> bool:
    T = pose_matrix(pose)
    return bool((points @ T[2, :3] + T[2, 3] > 0).all())
