"""Frame after frame between keyframes: predicted, solved from the window's landmarks, refused where no hand moves that far."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from vli_backend.config import BackEndConfig
from vli_backend.frame_pose import FramePose, pose_by_features, solve_frame_pose
from vli_backend.landmarks import LandmarkPoints
from vli_backend.prediction import Prediction, Predictor
from vli_backend.smoother import KeyframeState
from vli_backend.track_noise import whitening
from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration
from vli_common.types import Tracks


@dataclass(frozen=True)
class TrackedFrame:
    """Pose of a frame, and the velocity (3,) of imu_link in map that was predicted for it."""

    pose: FramePose
    velocity: FloatArray


class FrameTracker:
    """Follows the scanner from keyframe to keyframe.

    Args:
        calibration: camera, IMU.
        config: parameters.
        T_imu_cam: (4, 4).
        near_m: how far a hand moves between two frames at most: the least distance of a surface.
    """

    def __init__(self, calibration: Calibration, config: BackEndConfig, T_imu_cam: FloatArray, near_m: float) -> None:
        self._camera, self._config = calibration.camera, config
        self._near_m = self._limit_m = near_m
        self._predictor = Predictor(T_imu_cam, calibration.blind_s)

    @property
    def angular_velocity(self) -> FloatArray:
        """Angular velocity (3,) of imu_link in imu_link, from the last two frames, rad/s."""
        return self._predictor.angular_velocity

    def set_keyframe(self, stamp_ns: int, state: KeyframeState) -> None:
        """Go on from a solved keyframe, which is also the newest frame."""
        self._predictor.set_keyframe(stamp_ns, state)

    def observe(self, stamp_ns: int, T_map_camera: FloatArray) -> None:
        """Take the pose of a frame that was found elsewhere."""
        self._predictor.observe(stamp_ns, T_map_camera)

    def track(
        self,
        tracks: Tracks,
        imu: gtsam.PreintegratedCombinedMeasurements | None,
        inflate: float,
        landmarks: LandmarkPoints,
    ) -> TrackedFrame:
        """Return the pose of the next frame.

        Args:
            tracks: of the frame.
            imu: preintegration from the newest keyframe to it, or None.
            inflate: factor on the variances of the IMU.
            landmarks: in map.
        """
        predicted = self._predictor.predict(tracks.stamp_ns, imu, tracks.stationary, inflate)
        self._limit_m = self._near_m + predicted.reach_m
        found = self._solve(tracks, predicted, landmarks)
        if self.jump(predicted.T_map_camera, found.T_map_camera) is not None:
            # The features are wrong, or the prediction is. Neither makes a pose.
            found = FramePose(predicted.T_map_camera, predicted.information, 0, np.inf, found.iterations)
        self._predictor.observe(tracks.stamp_ns, found.T_map_camera)
        return TrackedFrame(found, predicted.velocity)

    def jump(self, before: FloatArray, after: FloatArray) -> float | None:
        """Return the metres between two poses of the newest frame where no hand moves that far, or one is not finite."""
        distance = float(np.linalg.norm(after[:3, 3] - before[:3, 3]))
        return None if distance < self._limit_m else distance

    def _solve(self, tracks: Tracks, predicted: Prediction, landmarks: LandmarkPoints) -> FramePose:
        _, rows, columns = np.intersect1d(landmarks.ids, tracks.ids, assume_unique=True, return_indices=True)
        points, rays = landmarks.positions[rows], tracks.rays[columns]
        start = pose_by_features(points, rays, self._camera.focal_px) if predicted.reach_m else None
        return solve_frame_pose(
            predicted.T_map_camera if start is None else start,
            predicted.information,
            points,
            landmarks.spread[rows],
            rays,
            whitening(self._camera, tracks, self._config.pixel_sigma)[columns],
            self._config.cauchy,
        )
