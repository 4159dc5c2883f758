"""The back end: a pose for every long frame, a solved window at every keyframe.

:class:`BackEnd` is the state machine around two estimators: :class:`vli_backend.estimator.WindowEstimator` while tracking and
:class:`vli_backend.starter.Starter` before.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vli_backend.config import BackEndConfig
from vli_backend.estimator import WindowEstimator
from vli_backend.smoother import SmootherError
from vli_backend.starter import Starter
from vli_common.calibration import Calibration
from vli_common.types import (
    BackEndOutput,
    Counters,
    FrontEndOutput,
    LaserScan,
    MapConstraints,
    Mode,
    TrackingState,
    WindowPoses,
)

_CONSTRAINTS_AGE = 2
"""Map constraints that answer an older keyframe than this many ago are dropped."""


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
        self._estimator: WindowEstimator | None = None
        self._new_starter = starter
        self._starter = starter(calibration, config, mode)
        self._degraded_since_ns: int | None = None
        self._resume_pose = np.eye(4)

    def reset(self, session: int, reason: str) -> None:
        """Forget everything of the old session and wait for a new start."""
        self.session = session
        self._resume_pose = np.eye(4)
        self._restart(TrackingState.INITIALISING, reason)

    def add_scan(self, scan: LaserScan) -> None:
        """Take the stripe of one short frame."""
        if scan.session != self.session:
            self.counters.add("scans_of_other_sessions")
        elif self._mode.uses_laser and len(scan):
            (self._estimator or self._starter).add_scan(scan)

    def add_constraints(self, constraints: MapConstraints) -> None:
        """Take window-to-map correspondences for the next solve."""
        if constraints.session != self.session or self._estimator is None:
            self.counters.add("map_constraints_of_other_sessions")
        elif constraints.stamp_ns not in self._estimator.recent_keyframes(_CONSTRAINTS_AGE):
            self.counters.add("map_constraints_late")
        else:
            self._estimator.constraints = constraints

    def add_frame(self, frame: FrontEndOutput) -> BackEndOutput:
        """Take the tracks and the preintegrated IMU of one long frame; return what is known of it."""
        stamp = frame.tracks.stamp_ns
        if frame.tracks.session != self.session:
            self.counters.add("frames_of_other_sessions")
            return BackEndOutput(stamp, self.state, self.reason)
        try:
            if self._estimator is None:
                return self._start(frame)
            return self._track(frame, self._estimator)
        except SmootherError as error:
            self.counters.add("solver_failures")
            return self._lose(stamp, f"solver failed: {error}")

    def flush(self) -> WindowPoses | None:
        """Return everything still in the window as final (end of input, pause, reset)."""
        window = self._estimator.flush(self.session) if self._estimator is not None else None
        if window is not None:
            self._restart(TrackingState.INITIALISING, "window flushed")
        return window

    def _start(self, frame: FrontEndOutput) -> BackEndOutput:
        self._estimator = self._starter.add_frame(frame, self._resume_pose)
        if self._estimator is None:
            if self.state is not TrackingState.LOST:
                self.state = TrackingState.INITIALISING
            self.reason = self._starter.reason
            return BackEndOutput(frame.tracks.stamp_ns, self.state, self.reason)
        self.counters.add("starts")
        self.state, self.reason = TrackingState.TRACKING, self._starter.reason
        result = self._estimator.current(frame.tracks.stamp_ns, self.session)
        return BackEndOutput(frame.tracks.stamp_ns, self.state, self.reason, result.pose, result.window, result.bias)

    def _track(self, frame: FrontEndOutput, estimator: WindowEstimator) -> BackEndOutput:
        stamp = frame.tracks.stamp_ns
        result = estimator.add_frame(frame, self.session)
        self.counters.add("keyframes", int(frame.tracks.keyframe))
        if result.landmarks >= self._config.min_landmarks:
            self._degraded_since_ns = None
            self.state, self.reason = TrackingState.TRACKING, ""
        else:
            since = self._degraded_since_ns = self._degraded_since_ns or stamp
            self.state = TrackingState.DEGRADED
            self.reason = f"{result.landmarks} features match the window, {self._config.min_landmarks} are needed"
            if stamp - since > self._config.lost_after_s * 1e9:
                return self._lose(stamp, self.reason)
        return BackEndOutput(stamp, self.state, self.reason, result.pose, result.window, result.bias)

    def _lose(self, stamp_ns: int, reason: str) -> BackEndOutput:
        """Give up the window: what it holds becomes final, and a new one starts where it ended."""
        estimator = self._estimator
        window = None
        if estimator is not None:
            window = estimator.flush(self.session)
            self._resume_pose = estimator.last_pose
        self.counters.add("lost")
        self._restart(TrackingState.LOST, reason)
        return BackEndOutput(stamp_ns, self.state, reason, window=window)

    def _restart(self, state: TrackingState, reason: str) -> None:
        self.state, self.reason = state, reason
        self._estimator = None
        self._starter = self._new_starter(self._calibration, self._config, self._mode)
        self._degraded_since_ns = None
