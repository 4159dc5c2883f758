"""The sliding window at work: frame poses between keyframes, the smoother at keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import gtsam
import numpy as np

from vli_backend.condense import Quadratic, condense, refine
from vli_backend.config import BackEndConfig
from vli_backend.depth_prior import DepthPrior
from vli_backend.frame_pose import FramePose
from vli_backend.frame_tracker import FrameTracker
from vli_backend.landmarks import LandmarkPoints, LandmarkTable
from vli_backend.laser_depth import measure_keyframes
from vli_backend.map_residuals import condense_map
from vli_backend.plane_residuals import PlaneResiduals, plane_residuals
from vli_backend.pose_covariance import PoseCovariance
from vli_backend.smoother import Condenser, GtsamSmoother, KeyframeState, Smoother, SmootherError, StatePrior
from vli_backend.track_noise import whitening
from vli_backend.window import FrameRecord, Window, close_interval
from vli_common.arrays import BoolArray, FloatArray
from vli_common.calibration import Calibration
from vli_common.geometry import inverse
from vli_common.types import (
    FrontEndOutput,
    ImuBias,
    LaserScan,
    MapConstraints,
    PoseEstimate,
    Preintegration,
    TrackFlag,
    Tracks,
    WindowPoses,
)

_WIDE, _WIDE_ITERATIONS = 10.0, 5
"""Times the width of the robust loss with which the first windows are solved before: where depths are guesses yet, and the scale
with them, all that the laser says would be outliers."""


@dataclass(frozen=True)
class FrameResult:
    """Live pose of a frame; at a keyframe also the window and the bias; number of landmarks that fit.

    ``problem``: why the solver failed at first; the keyframe is then held weakly where it was predicted.
    """

    pose: PoseEstimate | None
    landmarks: int
    window: WindowPoses | None = None
    bias: ImuBias | None = None
    problem: str = ""


class WindowEstimator:
    """Poses, velocities and biases of the newest keyframes, and the pose of every frame since.

    Args:
        calibration: camera, IMU, laser.
        config: parameters.
        first: tracks of the first keyframe.
        state: its state.
        prior: how well that is known.
        scans: stripes seen so far.
        depths: where surfaces may be.
    """

    def __init__(
        self,
        calibration: Calibration,
        config: BackEndConfig,
        first: Tracks,
        state: KeyframeState,
        prior: StatePrior,
        scans: list[LaserScan],
        depths: DepthPrior,
    ) -> None:
        self._config = config
        self._camera = calibration.camera
        self._T_cam_imu = calibration.T_cam_imu if calibration.T_cam_imu is not None else np.eye(4)
        self._T_imu_cam = inverse(self._T_cam_imu)
        self._depths = depths
        self._limits = depths.inverse_limits
        self._longest_ns = round(calibration.blind_s * 1e9)
        self._smoother: Smoother = GtsamSmoother(config.window_keyframes)
        self._landmarks = LandmarkTable(config.window_keyframes + 1, depths.spread)
        self._window = Window()
        self._scans = list(scans)
        self._restarted: set[int] = set()
        self._moving_keyframes = 0
        self._T_map_odom = np.eye(4)
        self.constraints: MapConstraints | None = None
        """For the next solve."""
        self._map: MapConstraints | None = None
        """Of the newest solve: its marginalisation takes the same, whatever has come since."""
        self.plane_residuals: PlaneResiduals | None = None
        """Laser depths of the landmarks that left last, compared with vision."""

        self._smoother.start(state, prior)
        self._state = state
        self._candidate = first, state
        self._scale: tuple[float, float] | None = None
        self._window.append(first.stamp_ns, first.stationary, None)
        self._add_observations(first)
        self._records = [FrameRecord(first.stamp_ns, state.T_map_imu @ self._T_imu_cam, first.stationary)]
        self._tracker = FrameTracker(calibration, config, self._T_imu_cam, depths.near)
        self._tracker.set_keyframe(first.stamp_ns, state)
        self._covariance = PoseCovariance(self._T_imu_cam, config.covariance_scale)
        self._covariance.set_keyframe(first.stamp_ns, state.T_map_imu, self._smoother.newest_covariance())
        self._measure_depths(0)
        self._points = self._landmarks.points(self._keyframe_poses())

    @property
    def newest(self) -> tuple[int, KeyframeState]:
        """Stamp and state of the newest keyframe: where a new window or dead reckoning begins when this one ends."""
        return self._window.stamps[-1], self._state

    @property
    def restart(self) -> tuple[Tracks, KeyframeState]:
        """Tracks of the newest keyframe and its state, as guessed where the solver fails on it: where a new window begins."""
        return self._candidate

    @property
    def scans(self) -> list[LaserScan]:
        """Stripes since the newest keyframe."""
        return list(self._scans)

    @property
    def landmarks(self) -> LandmarkPoints:
        """Landmarks whose tracks go on, in map."""
        return self._points

    def adopt(self, landmarks: LandmarkPoints) -> None:
        """Take what a window that has just ended knew of the depths; only while this one has a single keyframe."""
        self._landmarks.adopt(landmarks, self._records[0].T_map_camera, self._depths.near)
        self._points = self._landmarks.points(self._keyframe_poses())

    def recent_keyframes(self, count: int) -> list[int]:
        """Return the stamps of the newest ``count`` keyframes."""
        return self._window.stamps[-count:]

    def add_scan(self, scan: LaserScan) -> None:
        """Keep a stripe until its keyframe interval closes."""
        self._scans.append(scan)

    def current(self, stamp_ns: int, session: int) -> FrameResult:
        """Return the newest state as the result of a frame that has just started the window."""
        if stamp_ns > self._records[-1].stamp_ns:
            last = self._records[-1]
            self._records.append(FrameRecord(stamp_ns, last.T_map_camera, last.stationary))
            self._tracker.observe(stamp_ns, last.T_map_camera)
        pose = self._estimate(
            stamp_ns, self._records[-1].T_map_camera, self._state.velocity, self._covariance.of_keyframe(), session
        )
        return FrameResult(
            pose, len(self._points.ids), self._window.poses(self._keyframe_poses(), 0, session), self._bias(session)
        )

    def add_frame(self, frame: FrontEndOutput, session: int) -> FrameResult:
        """Return the pose of one long frame; at a keyframe, solve the window.

        The oldest keyframe of a full window is marginalised with the frame after the solve: no frame has to do both.
        """
        self._make_room()
        tracks, imu = frame.tracks, self._usable(frame.preintegration)
        inflate = frame.preintegration.inflate if frame.preintegration is not None else 1.0
        tracked = self._tracker.track(tracks, imu, inflate, self._points)
        found = tracked.pose
        self._restarted.update(int(i) for i in tracks.ids[(tracks.flags & TrackFlag.TEMPLATE) > 0])
        self._records.append(FrameRecord(tracks.stamp_ns, found.T_map_camera, tracks.stationary))
        if tracks.keyframe:
            return self._add_keyframe(tracks, imu, found, tracked.velocity, session)
        covariance = self._covariance.of_frame(found.T_map_camera @ self._T_cam_imu, found.information)
        pose = self._estimate(tracks.stamp_ns, found.T_map_camera, tracked.velocity, covariance, session)
        return FrameResult(pose, found.inliers)

    def add_scale(self, ratio: float, sigma: float) -> None:
        """Take how long the path is against its present scale, with a relative sigma, for the next solve."""
        self._scale = ratio, sigma

    def add_start_keyframe(
        self,
        tracks: Tracks,
        state: KeyframeState,
        imu: gtsam.PreintegratedCombinedMeasurements | None,
        between: Sequence[FrameRecord] = (),
    ) -> None:
        """Append a keyframe whose state a start in motion has found, and the frames since the last one.

        :meth:`finish_start` solves them together.
        """
        self._records.extend(between)
        self._records.append(FrameRecord(tracks.stamp_ns, state.T_map_imu @ self._T_imu_cam, tracks.stationary))
        self._append_keyframe(tracks, state, imu)
        self._state = state

    def finish_start(self, scale_sigma: float | None = None) -> None:
        """Solve the window of a start in motion; ``scale_sigma``: how well its scale is known, relative, where no laser tells."""
        if scale_sigma is not None:
            self._smoother.hold_scale(1.0, scale_sigma)
        self._measure_depths(0)
        self._landmarks.widen(self._depths.first_spread)
        covariance, _ = self._solve(is_first=True)
        self._records = [
            FrameRecord(self._window.stamps[-1], self._state.T_map_imu @ self._T_imu_cam, self._window.stationary[-1])
        ]
        self._tracker.set_keyframe(self._window.stamps[-1], self._state)
        self._covariance.set_keyframe(self._window.stamps[-1], self._state.T_map_imu, covariance)

    def flush(self, session: int) -> WindowPoses | None:
        """Return all frames as final, those after the newest keyframe included."""
        poses = self._keyframe_poses()
        if self._is_full:
            # Its last word has been said, and a solver that has failed is not asked again.
            self._window.drop_oldest()
            poses = poses[1:]
        if len(self._records) > 1:
            interval = close_interval(self._records, self._scans, self._longest_ns)
            last = self._records[-1]
            self._window.append(last.stamp_ns, last.stationary, interval)
            poses = np.concatenate([poses, last.T_map_camera[None]])
        return self._window.poses(poses, len(self._window), session)

    # -- one frame ---------------------------------------------------------------------------------------------------------

    def _usable(self, preintegration: Preintegration | None) -> gtsam.PreintegratedCombinedMeasurements | None:
        """Return the GTSAM object if it starts at the newest keyframe."""
        if preintegration is None or preintegration.from_ns != self._window.stamps[-1]:
            return None
        return cast(gtsam.PreintegratedCombinedMeasurements, preintegration.measurements)

    # -- one keyframe ------------------------------------------------------------------------------------------------------

    def _add_keyframe(
        self,
        tracks: Tracks,
        imu: gtsam.PreintegratedCombinedMeasurements | None,
        found: FramePose,
        velocity: FloatArray,
        session: int,
    ) -> FrameResult:
        T_odom_imu = inverse(self._T_map_odom) @ found.T_map_camera @ self._T_cam_imu
        state = KeyframeState(found.T_map_camera @ self._T_cam_imu, velocity, self._state.gyro_bias, self._state.accel_bias)
        self._candidate = tracks, state
        self._append_keyframe(tracks, state, imu)
        moving = not tracks.stationary
        if moving and not self._moving_keyframes:
            self._landmarks.widen(self._depths.first_spread)
        self._moving_keyframes += int(moving)
        first_ones = moving and self._moving_keyframes <= self._config.start_keyframes
        covariance, problem = self._solve(first_ones)
        self._candidate = tracks, self._state
        self._tracker.set_keyframe(tracks.stamp_ns, self._state)
        T = self._state.T_map_imu
        self._records = [FrameRecord(tracks.stamp_ns, T @ self._T_imu_cam, tracks.stationary)]
        self._T_map_odom = T @ inverse(T_odom_imu)
        window = self._window.poses(self._keyframe_poses(), int(self._is_full), session)
        self._covariance.set_keyframe(tracks.stamp_ns, T, covariance, self._on_map)
        pose = self._estimate(
            tracks.stamp_ns, self._records[0].T_map_camera, self._state.velocity, self._covariance.of_keyframe(), session
        )
        return FrameResult(pose, found.inliers, window, self._bias(session), problem)

    def _append_keyframe(self, tracks: Tracks, state: KeyframeState, imu: gtsam.PreintegratedCombinedMeasurements | None) -> None:
        elapsed_s = (tracks.stamp_ns - self._window.stamps[-1]) * 1e-9
        still = all(record.stationary for record in self._records)
        self._window.append(tracks.stamp_ns, tracks.stationary, close_interval(self._records, self._scans, self._longest_ns))
        self._scans = [scan for scan in self._scans if scan.stamp_ns > tracks.stamp_ns]
        self._smoother.add_keyframe(state, imu, elapsed_s)
        if still:
            self._smoother.hold_still()
        if self._scale is not None:
            self._smoother.hold_scale(*self._scale)
            self._scale = None
        self._add_observations(tracks)
        self._records = self._records[-1:]

    def _add_observations(self, tracks: Tracks) -> None:
        self._landmarks.forget_lost(tracks.ids)
        restarted = np.isin(tracks.ids, np.fromiter(self._restarted, np.int64, len(self._restarted)))
        white = whitening(self._camera, tracks, self._config.pixel_sigma)
        self._landmarks.add_keyframe(tracks.ids, tracks.rays, white, restarted, self._depth_guess())
        self._restarted.clear()

    def _depth_guess(self) -> float:
        scan = self._scans[-1] if self._scans else self._window.newest_scan
        return self._depths.guess(scan, self._landmarks.arrays.rho[self._landmarks.usable])

    def _solve(self, is_first: bool) -> tuple[FloatArray, str]:
        """Find depths, then poses, velocities and biases of the window.

        Args:
            is_first: the window is one of the first in motion.

        Returns:
            Covariance (6, 6) of the newest pose; why the solver failed at first, if it did: what it knew is kept.
        """
        # The one before the newest lacked the scans after it.
        self._measure_depths(len(self._window) - 2)
        self._map = self.constraints
        use, intervals = self._landmarks.usable, range(len(self._window.intervals))
        iterations = self._config.start_iterations if is_first else self._config.iterations
        condenser, problem = self._condenser(use, intervals), ""
        try:
            if is_first:
                self._smoother.solve(self._condenser(use, intervals, _WIDE), _WIDE_ITERATIONS)
            self._smoother.solve(condenser, iterations)
            covariance = self._smoother.newest_covariance()
        except SmootherError as error:
            problem = str(error)
            self._smoother.hold_newest()
            self._smoother.solve(condenser, iterations)
            covariance = self._smoother.newest_covariance()
        self._state = self._smoother.states()[-1]
        jump = self._tracker.jump(self._records[-1].T_map_camera, self._state.T_map_imu @ self._T_imu_cam)
        if jump is not None:
            raise SmootherError(f"the newest keyframe jumped by {jump:.3f} m")
        poses = self._keyframe_poses()
        self._refine(poses, np.ones(len(self._landmarks), np.bool_), self._config.cauchy)
        self._points = self._landmarks.points(poses)
        return covariance, problem

    def _condenser(self, use: BoolArray, map_intervals: range, width: float = 1.0) -> Condenser:
        """Return what linearises the used landmarks, and the map constraints of the stripes in some of the intervals.

        Args:
            use: (L,), which landmarks.
            map_intervals: of the window.
            width: of the robust loss of landmarks, times that of the configuration.
        """
        cauchy = width * self._config.cauchy

        def linearise(T_map_imu: FloatArray) -> Quadratic:
            poses = T_map_imu @ self._T_imu_cam
            self._refine(poses, use, cauchy)
            quadratic = condense(self._landmarks.arrays, poses, use, cauchy)
            if self._map is not None and len(self._map) and len(map_intervals):
                quadratic = quadratic + condense_map(
                    self._map,
                    self._window.stamps,
                    self._window.intervals,
                    map_intervals,
                    poses,
                    self._config.map_sigma_scale,
                    self._config.map_cauchy,
                )
            return quadratic.in_body_frame(self._T_cam_imu)

        return linearise

    def _refine(self, poses: FloatArray, use: BoolArray, cauchy: float) -> None:
        information = refine(self._landmarks.arrays, poses, use, cauchy, self._limits)
        self._landmarks.information[use] = information[use]

    @property
    def _is_full(self) -> bool:
        return len(self._window) > self._config.window_keyframes

    def _make_room(self) -> None:
        """Marginalise the oldest keyframe if the window is full; what it said of its frames was their last word."""
        if not self._is_full:
            return
        poses = self._keyframe_poses()
        oldest_rows = self._landmarks.arrays.anchor == 0
        self.plane_residuals = plane_residuals(self._landmarks, oldest_rows, poses, self._config.cauchy, self._limits)
        leaving = self._landmarks.split()
        stays = self._landmarks.usable & ~leaving
        # What the map says of the oldest interval leaves with it; the rest goes on holding the window.
        oldest, rest = range(1), range(1, len(self._window.intervals))
        self._smoother.marginalise_oldest(self._condenser(self._landmarks.usable & leaving, oldest), self._condenser(stays, rest))
        self._landmarks.drop_oldest(leaving)
        self._window.drop_oldest()
        self._points = self._landmarks.points(self._keyframe_poses())

    def _measure_depths(self, first: int) -> None:
        """Give the features of the keyframes from slot ``first`` on their laser depth, eq. (2)."""
        focal = self._camera.focal_px
        measure_keyframes(self._landmarks, self._window, self._keyframe_poses(), first, self._scans, focal, self._config)

    @property
    def _on_map(self) -> bool:
        """Whether map constraints on scans of the window took part in the newest solve."""
        return self._map is not None and bool((self._map.scan_stamps > self._window.stamps[int(self._is_full)]).any())

    # -- views -------------------------------------------------------------------------------------------------------------

    def _keyframe_poses(self) -> FloatArray:
        """Return ``T_map_camera`` (K, 4, 4) of the window."""
        result: FloatArray = self._smoother.poses() @ self._T_imu_cam
        return result

    def _bias(self, session: int) -> ImuBias:
        return ImuBias(self._window.stamps[-1], self._state.gyro_bias, self._state.accel_bias, session)

    def _estimate(
        self,
        stamp_ns: int,
        T_map_camera: FloatArray,
        velocity: FloatArray,
        covariance: FloatArray,
        session: int,
    ) -> PoseEstimate:
        return PoseEstimate(
            stamp_ns,
            T_map_camera @ self._T_cam_imu,
            self._T_map_odom,
            velocity,
            self._tracker.angular_velocity,
            covariance,
            session,
        )
