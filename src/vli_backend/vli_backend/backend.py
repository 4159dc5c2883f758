"""The back end: a pose for every long frame, a solved window at every keyframe.

:class:`BackEnd` is the state machine around two estimators: :class:`vli_backend.estimator.WindowEstimator` while tracking and
:class:`vli_backend.starter.Starter` before.

A loss ends the window, not the session: the map is kept, and the next window begins where the IMU has carried the scanner
meanwhile. Until :meth:`BackEnd.relocalise` says where that is in the map, the poses carry the uncertainty of the guess and the
state says so.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vli_backend.config import BackEndConfig
from vli_backend.dead_reckoning import DeadReckoning
from vli_backend.depth_prior import DepthPrior
from vli_backend.estimator import FrameResult, WindowEstimator
from vli_backend.inertial_scale import InertialScale
from vli_backend.laser_check import LaserCheck
from vli_backend.placement import Placement
from vli_backend.smoother import SmootherError, StatePrior
from vli_backend.starter import Starter
from vli_common.calibration import Calibration
from vli_common.types import (
    NANOSECONDS,
    BackEndOutput,
    Counters,
    FrontEndOutput,
    LaserScan,
    MapConstraints,
    Mode,
    Relocalisation,
    TrackingState,
    WindowPoses,
)

_CONSTRAINTS_AGE = 2
"""Map constraints that answer an older keyframe than this many ago are dropped."""
_NO_LASER_NS, _NO_IMU_NS = 2 * NANOSECONDS, NANOSECONDS // 2
"""A sensor that says nothing for so long is missed."""
_SOLVER_ERRORS = (SmootherError, np.linalg.LinAlgError)
_RECOVERY_NS = NANOSECONDS
"""A solver that fails twice within this has lost the window."""
_RESTART_VELOCITY = 0.02
"""m/s: how well the velocity is known when a window begins anew from the one before."""


class BackEnd:
    """Initialisation, fixed-lag smoothing and tracking state of one scanner.

    Args:
        calibration: camera, IMU, laser.
        config: parameters.
        mode: which sensors take part.
        starter: makes what waits for a start, at first and after every loss.
    """

    def __init__(
        self,
        calibration: Calibration,
        config: BackEndConfig,
        mode: Mode,
        starter: Callable[[Calibration, BackEndConfig, Mode], Starter] = Starter,
    ) -> None:
        self._calibration = calibration
        self._config = config
        self._mode = mode
        self.counters = Counters()
        self.session = 0
        self.state = TrackingState.INITIALISING
        self.reason = "waiting for the first frame"
        self._lost_by = ""
        """Why the last window was given up, until the next one has started."""
        self._estimator: WindowEstimator | None = None
        self._new_starter = starter
        self._starter = starter(calibration, config, mode)
        self._laser_check = LaserCheck(calibration, config, mode)
        self._inertial_scale = InertialScale.of_scene(calibration, config)
        self._reckoning, self._placement = DeadReckoning(), Placement()
        self._last_scan_ns, self._last_imu_ns, self._last_good_ns, self._last_frame_ns, self._unseen_ns = 0, 0, 0, 0, 0
        self._last_failure_ns, self._placed_ns = -_RECOVERY_NS, -1
        self._longest_unseen_ns = round(calibration.blind_s * NANOSECONDS)

    def reset(self, session: int, reason: str) -> None:
        """Forget everything of the old session and wait for a new start."""
        self.session = session
        self.state, self.reason, self._lost_by = TrackingState.INITIALISING, reason, ""
        self._begin_map()

    def relocalise(self, found: Relocalisation) -> None:
        """Take where this session is in the map: from now on everything is published there.

        One of another session, or of a window that has moved or is no more, is dropped and counted.
        """
        if found.session != self.session:
            self.counters.add("relocalisations_of_other_sessions")
            return
        known = self._estimator.recent_keyframes(self._config.window_keyframes) if self._estimator is not None else []
        if found.stamp_ns not in known or found.stamp_ns <= self._placed_ns:
            self.counters.add("relocalisations_late")
            return
        self._placement.relocalise(found.T_map_session, found.sigma_m)
        self._placed_ns = known[-1]
        if self._estimator is not None:
            # They were found where the window is no more.
            self._estimator.constraints = None
        self.counters.add("relocalisations")

    @property
    def is_located(self) -> bool:
        """False between a loss and a relocalisation: where the window is in the map is a guess."""
        return self._placement.is_located

    def add_scan(self, scan: LaserScan) -> None:
        """Take the stripe of one short frame."""
        if scan.session != self.session:
            self.counters.add("scans_of_other_sessions")
        elif self._mode.uses_laser and len(scan):
            self._last_scan_ns = scan.stamp_ns
            (self._estimator or self._starter).add_scan(scan)

    def add_constraints(self, constraints: MapConstraints) -> None:
        """Take window-to-map correspondences for the next solve."""
        if constraints.session != self.session or self._estimator is None:
            self.counters.add("map_constraints_of_other_sessions")
        elif constraints.stamp_ns not in self._estimator.recent_keyframes(_CONSTRAINTS_AGE):
            self.counters.add("map_constraints_late")
        elif constraints.stamp_ns <= self._placed_ns:
            self.counters.add("map_constraints_before_relocalisation")
        else:
            self._estimator.constraints = self._placement.to_window(constraints)

    def add_frame(self, frame: FrontEndOutput) -> BackEndOutput:
        """Take the tracks and the preintegrated IMU of one long frame; return what is known of it."""
        stamp = frame.tracks.stamp_ns
        if frame.tracks.session != self.session:
            self.counters.add("frames_of_other_sessions")
            return BackEndOutput(stamp, self.state, self.reason)
        if frame.preintegration is not None:
            self._last_imu_ns = stamp
        try:
            if self._estimator is None:
                return self._start(frame)
            return self._track(frame, self._estimator)
        except _SOLVER_ERRORS as error:
            self.counters.add("solver_failures")
            return self._recover(frame, str(error))

    def flush(self) -> WindowPoses | None:
        """Return everything still in the window as final (end of input, pause, reset)."""
        if self._estimator is None:
            return None
        return self._end_window(TrackingState.INITIALISING, "window flushed")

    def _start(self, frame: FrontEndOutput) -> BackEndOutput:
        stamp = frame.tracks.stamp_ns
        self._reckoning.add_frame(frame)
        estimator = self._starter.add_frame(frame, self._reckoning)
        if estimator is None:
            self.reason = "; a new start: ".join(filter(None, [self._lost_by, self._starter.reason]))
            return BackEndOutput(stamp, self.state, self.reason)
        self._estimator, self._lost_by = estimator, ""
        self.counters.add("starts")
        self._placement.guess(self._reckoning.sigma_m)
        self.state, self.reason = TrackingState.TRACKING, self._starter.reason
        if not self._placement.is_located:
            self.reason += f", {self._reckoning.elapsed_s(stamp):.1f} s after the loss"
        self._reckoning = DeadReckoning(*estimator.newest)
        self._last_good_ns = self._last_frame_ns = stamp
        self._unseen_ns = 0
        return self._output(stamp, estimator.current(stamp, self.session))

    def _track(self, frame: FrontEndOutput, estimator: WindowEstimator) -> BackEndOutput:
        stamp = frame.tracks.stamp_ns
        self._unseen_ns, self._last_frame_ns = stamp - self._last_frame_ns, stamp
        # Before the solve: where that fails, this is how the frame came here.
        self._reckoning.add_frame(frame)
        result = estimator.add_frame(frame, self.session)
        self.counters.add("keyframes", int(frame.tracks.keyframe))
        carrier = "the IMU carries it" if frame.preintegration is not None else "nothing carries it"
        if result.landmarks >= self._config.min_landmarks:
            self._last_good_ns = stamp
            if frame.tracks.keyframe:
                self._reckoning = DeadReckoning(*estimator.newest)
            self._check_scale(frame, result, estimator)
            self.state, self.reason = TrackingState.TRACKING, self._hint(stamp)
            if result.problem:
                self.counters.add("solver_rescues")
                self.state, self.reason = TrackingState.DEGRADED, f"solver failed, the keyframe is held weakly: {result.problem}"
            if self._was_blind:
                self.state = TrackingState.DEGRADED
                self.reason = f"no image for {self._unseen_ns / NANOSECONDS:.1f} s: {carrier}"
            return self._output(stamp, result)
        blind_s = (stamp - self._last_good_ns) / NANOSECONDS
        self.state = TrackingState.DEGRADED
        self.reason = (
            f"{result.landmarks} features match the window, {self._config.min_landmarks} are needed: "
            f"{carrier} for {blind_s:.1f} s"
        )
        if blind_s > self._config.lost_after_s or (self._was_blind and frame.preintegration is None):
            return self._lose(stamp, f"too few features for {blind_s:.1f} s: covered lens, darkness or fast motion")
        return self._output(stamp, result)

    @property
    def _was_blind(self) -> bool:
        """Whether the newest frame came after a gap between images."""
        return self._unseen_ns > self._longest_unseen_ns

    def _check_scale(self, frame: FrontEndOutput, result: FrameResult, estimator: WindowEstimator) -> None:
        """Compare the scale with the IMU's: with the laser to watch over its plane, without it to sharpen the scale itself."""
        if self._mode.uses_laser:
            self._laser_check.add_frame(frame, result.pose, estimator.plane_residuals)
        elif result.pose is not None and (piece := self._inertial_scale.add_frame(frame, result.pose)) is not None:
            estimator.add_scale(*piece)

    def _hint(self, stamp_ns: int) -> str:
        """Return what is missing although it tracks, in words; empty where nothing is."""
        silent = (
            ("no laser for {:.1f} s: the landmarks hold the scale", self._mode.uses_laser, self._last_scan_ns, _NO_LASER_NS),
            ("no IMU for {:.1f} s: vision carries on without it", self._mode.uses_imu, self._last_imu_ns, _NO_IMU_NS),
        )
        missing = [
            text.format((stamp_ns - last) / NANOSECONDS)
            for text, used, last, longest in silent
            if used and stamp_ns - last > longest
        ]
        return "; ".join([*missing, *filter(None, [self._placement.hint, self._laser_check.hint])])

    def _output(self, stamp_ns: int, result: FrameResult) -> BackEndOutput:
        pose = None if result.pose is None else self._placement.of_pose(result.pose)
        window = None if result.window is None else self._placement.of_window(result.window)
        return BackEndOutput(stamp_ns, self.state, self.reason, pose, window, result.bias)

    def _lose(self, stamp_ns: int, reason: str) -> BackEndOutput:
        """Give up the window: what it holds becomes final, and a new one starts where the IMU carries it."""
        self.counters.add("lost")
        window = self._end_window(TrackingState.LOST, reason)
        return BackEndOutput(stamp_ns, self.state, reason, window=window)

    def _recover(self, frame: FrontEndOutput, problem: str) -> BackEndOutput:
        """After a solver's failure go on with a new window from the newest keyframe; LOST where that fails again at once.

        Also where the keyframe came after a gap between images: it is only where it was predicted.
        """
        estimator, stamp_ns = self._estimator, frame.tracks.stamp_ns
        if estimator is None or self._was_blind or stamp_ns - self._last_failure_ns < _RECOVERY_NS:
            return self._lose(stamp_ns, f"solver failed: {problem}")
        self._last_failure_ns = stamp_ns
        tracks, state = estimator.restart
        window = estimator.flush(self.session)
        config = self._config
        prior = StatePrior(
            np.full(3, config.tilt_sigma), 1e-6, _RESTART_VELOCITY, config.gyro_bias_sigma, config.accel_bias_sigma
        )
        depths = DepthPrior.of_scene(self._calibration, config)
        try:
            self._estimator = WindowEstimator(self._calibration, config, tracks, state, prior, estimator.scans, depths)
            self._estimator.adopt(estimator.landmarks)
            begins = tracks.stamp_ns == stamp_ns
            found = self._estimator.current(stamp_ns, self.session) if begins else self._estimator.add_frame(frame, self.session)
        except _SOLVER_ERRORS as error:
            return self._lose(stamp_ns, f"solver failed: {error}")
        self.counters.add("windows_renewed")
        self.state, self.reason = TrackingState.DEGRADED, f"solver failed, the window begins anew: {problem}"
        return self._output(stamp_ns, FrameResult(found.pose, found.landmarks, window))

    def _end_window(self, state: TrackingState, reason: str) -> WindowPoses | None:
        estimator = self._estimator
        window = None
        if estimator is not None:
            window = estimator.flush(self.session)
        self.state, self.reason = state, reason
        self._lost_by = reason if state is TrackingState.LOST else ""
        self._wait_for_start()
        return None if window is None else self._placement.of_window(window)

    def _begin_map(self) -> None:
        """Wait for the first start of a session: its place is the origin of the map."""
        self._reckoning, self._placement = DeadReckoning(), Placement()
        self._last_scan_ns, self._last_imu_ns = 0, 0
        self._last_failure_ns = -_RECOVERY_NS
        self._wait_for_start()

    def _wait_for_start(self) -> None:
        self._estimator = None
        self._starter = self._new_starter(self._calibration, self._config, self._mode)
        self._last_good_ns, self._placed_ns = 0, -1
        self._laser_check.begin_window()
        self._inertial_scale.clear()
