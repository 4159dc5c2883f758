"""The scale of a tracked path against the IMU, piece by piece: a check on the laser, and without it the scale itself."""

from __future__ import annotations

import numpy as np

from vli_backend.config import BackEndConfig
from vli_backend.depth_prior import DepthPrior
from vli_backend.inertial_alignment import AlignmentSigmas, VisualInterval, align_structure
from vli_backend.preintegrations import measurements_of
from vli_backend.visual_start import alignment_sigmas
from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration
from vli_common.geometry import inverse, pose
from vli_common.types import FrontEndOutput, PoseEstimate

_KEYFRAMES = 12
"""Compared with the IMU at a time."""


class InertialScale:
    """How long the path is by the IMU, in units of the laser's, piece by piece.

    Args:
        T_imu_cam: (4, 4).
        sigmas: see :class:`AlignmentSigmas`, position in metres.
    """

    @staticmethod
    def of_scene(calibration: Calibration, config: BackEndConfig) -> InertialScale:
        """Return one for a scanner at the distances of its scene."""
        T_cam_imu = calibration.T_cam_imu if calibration.T_cam_imu is not None else np.eye(4)
        sigmas = alignment_sigmas(calibration, config, DepthPrior.of_scene(calibration, config).first)
        return InertialScale(inverse(T_cam_imu), sigmas)

    def __init__(self, T_imu_cam: FloatArray, sigmas: AlignmentSigmas) -> None:
        self._T_imu_cam, self._sigmas = T_imu_cam, sigmas
        self.clear()

    def clear(self) -> None:
        """Begin a new piece."""
        self._keyframes: list[FloatArray] = []
        self._keyframe_ns = 0
        self._intervals: list[VisualInterval] = []
        self._since: list[tuple[FloatArray, FrontEndOutput]] = []

    def add_frame(self, frame: FrontEndOutput, estimate: PoseEstimate) -> tuple[float, float] | None:
        """Take a frame and its live pose; at the end of a piece return scale and relative sigma."""
        T_odom_imu = inverse(estimate.T_map_odom) @ estimate.T_map_imu
        seen = pose(T_odom_imu[:3, :3], (T_odom_imu @ self._T_imu_cam)[:3, 3])
        imu = frame.preintegration
        # Across a gap the IMU tells little of the path.
        follows = imu is not None and imu.from_ns == self._keyframe_ns and imu.inflate == 1.0
        if frame.tracks.stationary or (self._keyframes and not follows):
            self.clear()
        if self._keyframes:
            self._since.append((seen, frame))
        if not frame.tracks.keyframe:
            return None
        self._keyframe_ns = frame.tracks.stamp_ns
        if self._keyframes:
            self._intervals.append(_interval(self._since))
        self._keyframes.append(seen)
        self._since = []
        if len(self._keyframes) < _KEYFRAMES:
            return None
        found = align_structure(np.stack(self._keyframes), self._intervals, self._T_imu_cam[:3, 3], self._sigmas)
        self._keyframes, self._intervals = [seen], []
        return found.scale, found.scale_sigma


def _interval(frames: list[tuple[FloatArray, FrontEndOutput]]) -> VisualInterval:
    """Return the frames since the last keyframe, with all that can be worked out before the piece is at its end."""
    T = np.stack([seen for seen, _ in frames])
    result = VisualInterval(T[:, :3, 3], T[:, :3, :3], [measurements_of(frame.preintegration) for _, frame in frames])
    _ = result.deltas
    return result
