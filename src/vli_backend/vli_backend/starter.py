"""Collects frames until a window can be started, at rest or in motion, and says what is missing."""

from __future__ import annotations

from typing import cast

import gtsam
import numpy as np

from vli_backend.config import BackEndConfig
from vli_backend.dead_reckoning import DeadReckoning
from vli_backend.depth_prior import DepthPrior
from vli_backend.estimator import WindowEstimator
from vli_backend.initialisation import GRAVITY, align_imu, apply_alignment, rest_state
from vli_backend.motion_start import structure_from_motion
from vli_backend.smoother import KeyframeState, StatePrior
from vli_backend.visual_start import start_from_vision
from vli_backend.window import FrameRecord
from vli_common.calibration import Calibration
from vli_common.geometry import inverse, pose, so3_exp
from vli_common.types import FrontEndOutput, LaserScan, Mode, Preintegration, Tracks

_SCAN_MEMORY_NS = 4_000_000_000
_MIN_FEATURES = 15
_RETRY_NS = 250_000_000
"""Between two attempts of a start without laser: each adjusts up to thirty keyframes."""
_WORST_SCALE = 0.15
"""Relative sigma of the scale beyond which no patience starts a window."""
_FRAMES_WITHOUT_IMU = 5
_MOST_BETWEEN = 300
"""Frames that are kept between two keyframes, ten seconds: who waits at rest for a laser waits for any time."""
_VISUAL_WINDOWS = 3
"""Window lengths over which a start without laser compares images and IMU: the longer, the better it knows the scale."""


class Starter:
    """Waits for a start.

    At rest: one keyframe, gravity from the accelerometer, depths from the stripe. In motion: several keyframes with parallax,
    structure from motion with laser depths, then the IMU.

    Args:
        calibration: camera, IMU, laser.
        config: parameters.
        mode: which sensors take part.
    """

    def __init__(self, calibration: Calibration, config: BackEndConfig, mode: Mode) -> None:
        self._calibration = calibration
        self._config = config
        self._mode = mode
        self._depths = DepthPrior.of_scene(calibration, config)
        self._keyframes: list[FrontEndOutput] = []
        self._between: list[list[FrontEndOutput]] = []
        self._scans: list[LaserScan] = []
        self._moved = False
        self._without_imu = 0
        self._motion_since_ns = 0
        self._tried_ns = 0
        self.reason = "waiting for the first keyframe"

    def add_scan(self, scan: LaserScan) -> None:
        """Keep a stripe for the first depths."""
        self._scans.append(scan)
        while self._scans[-1].stamp_ns - self._scans[0].stamp_ns > _SCAN_MEMORY_NS:
            del self._scans[0]

    def add_frame(self, frame: FrontEndOutput, place: DeadReckoning) -> WindowEstimator | None:
        """Take one long frame; return the started window, or None with :attr:`reason` saying why not yet.

        Args:
            frame: of the front end.
            place: position and heading of the new window.
        """
        tracks = frame.tracks
        self._without_imu = self._without_imu + 1 if frame.preintegration is None and self._mode.uses_imu else 0
        self._keep(frame)
        self._moved |= not tracks.stationary
        if tracks.stationary or not self._motion_since_ns:
            self._motion_since_ns = tracks.stamp_ns
        if problem := self._missing(tracks):
            self.reason = problem
            return None
        if self._mode is Mode.VI:
            return self._start_from_vision(place) if tracks.keyframe else None
        if not self._moved or not self._mode.uses_imu:
            return self._start_at_rest(frame, place)
        if tracks.keyframe:
            return self._start_in_motion(place)
        return None

    def _keep(self, frame: FrontEndOutput) -> None:
        """Store a keyframe, and the frames between two: what stripes show is placed by them, and the IMU compared with them."""
        if not frame.tracks.keyframe:
            if self._between and frame.preintegration is not None and len(self._between[-1]) < _MOST_BETWEEN:
                self._between[-1].append(frame)
            return
        if self._keyframes and not self._connected(frame):
            self._keyframes.clear()
            self._between.clear()
        if self._between:
            self._between[-1].append(frame)
        self._keyframes.append(frame)
        self._between.append([])
        self._moved = not frame.tracks.stationary
        longest = self._config.window_keyframes * (_VISUAL_WINDOWS if self._mode is Mode.VI else 1)
        del self._keyframes[:-longest], self._between[:-longest]

    def _connected(self, frame: FrontEndOutput) -> bool:
        shared = np.intersect1d(frame.tracks.ids, self._keyframes[-1].tracks.ids)
        has_imu = frame.preintegration is not None or not self._mode.uses_imu
        return len(shared) >= _MIN_FEATURES and has_imu

    def _missing(self, tracks: Tracks) -> str | None:
        if not self._keyframes:
            return "waiting for the first keyframe"
        if len(tracks) < _MIN_FEATURES:
            return f"only {len(tracks)} features, {_MIN_FEATURES} are needed: more texture, more light, or closer"
        if self._mode.uses_laser and not self._scans:
            return "no laser stripe seen yet: is the laser on, and a surface within its range?"
        if self._without_imu > _FRAMES_WITHOUT_IMU:
            return "no IMU samples reach the frames: check the topic and the stamps of the IMU, or use --mode vl"
        return None

    def _start_at_rest(self, frame: FrontEndOutput, place: DeadReckoning) -> WindowEstimator | None:
        # Without IMU nothing tells the motion since the keyframe: the window of a scanner that moves begins here.
        first = frame.tracks if self._moved else self._keyframes[-1].tracks
        if not self._mode.uses_imu:
            self.reason = "started without IMU"
            return self._estimator(first, KeyframeState(place.at(first.stamp_ns), np.zeros(3), np.zeros(3), np.zeros(3)), 0.05)
        pim = _measurements(frame.preintegration)
        if pim is None or pim.deltaTij() < self._config.start_rest_s:
            self.reason = f"at rest, collecting IMU samples for {self._config.start_rest_s} s"
            return None
        self.reason = "started at rest"
        return self._estimator(first, _placed([rest_state(pim)], place, first.stamp_ns)[0], 0.01)

    def _start_in_motion(self, place: DeadReckoning) -> WindowEstimator | None:
        config = self._config
        if len(self._keyframes) < config.start_min_keyframes:
            self.reason = (
                f"in motion, {len(self._keyframes)} of {config.start_min_keyframes} keyframes that share features and IMU"
            )
            return None
        tracks = [frame.tracks for frame in self._keyframes]
        imu = [pim for frame in self._keyframes[1:] if (pim := _measurements(frame.preintegration)) is not None]
        between = [[item.tracks for item in interval] for interval in self._between[:-1]]
        structure = structure_from_motion(self._calibration, config, tracks, between, imu, self._scans)
        if structure.problem:
            self.reason = f"in motion, {structure.problem}"
            return None
        alignment = align_imu(structure.T_world_imu, imu)
        if abs(alignment.gravity_norm - GRAVITY) > 0.15 * GRAVITY:
            self.reason = f"in motion, gravity comes out as {alignment.gravity_norm:.1f} m/s²"
            return None
        states = _placed(apply_alignment(structure.T_world_imu, alignment), place, tracks[0].stamp_ns)
        estimator = self._estimator(tracks[0], states[0], 0.1)
        T_map_world = states[0].T_map_imu @ inverse(structure.T_world_imu[0])
        for k, (track, state, pim) in enumerate(zip(tracks[1:], states[1:], imu, strict=True)):
            inner = zip(between[k][:-1], T_map_world @ structure.between[k], strict=True)
            records = [FrameRecord(item.stamp_ns, T_map_camera, item.stationary) for item, T_map_camera in inner]
            estimator.add_start_keyframe(track, state, pim, records)
        estimator.finish_start()
        self.reason = "started in motion"
        return estimator

    def _start_from_vision(self, place: DeadReckoning) -> WindowEstimator | None:
        config = self._config
        if len(self._keyframes) < config.start_min_keyframes:
            self.reason = (
                f"{len(self._keyframes)} of {config.start_min_keyframes} keyframes; without the laser the scale needs motion"
            )
            return None
        tracks = [frame.tracks for frame in self._keyframes]
        if tracks[-1].stamp_ns - self._tried_ns < _RETRY_NS:
            return None
        self._tried_ns = tracks[-1].stamp_ns
        intervals = self._between[:-1]
        waited_s = (tracks[-1].stamp_ns - self._motion_since_ns) * 1e-9
        sigma = min(config.start_scale_sigma * max(1.0, waited_s / config.start_patience_s), _WORST_SCALE)
        found = start_from_vision(self._calibration, config, tracks[0], intervals, self._depths.first, sigma)
        if found.problem:
            self.reason = found.problem
            return None
        newest = slice(-config.window_keyframes, None)
        states = _placed(found.states, place, tracks[0].stamp_ns)[newest]
        tracks = tracks[newest]
        estimator = self._estimator(tracks[0], states[0], 0.1, self._depths.around(found.median_depth))
        imu = [_measurements(frame.preintegration) for frame in self._keyframes[newest][1:]]
        for track, state, pim in zip(tracks[1:], states[1:], imu, strict=True):
            estimator.add_start_keyframe(track, state, pim)
        estimator.finish_start(found.scale_sigma)
        self.reason = f"started from vision and IMU, scale known to {100 * found.scale_sigma:.1f} %"
        return estimator

    def _estimator(
        self, tracks: Tracks, state: KeyframeState, velocity_sigma: float, depths: DepthPrior | None = None
    ) -> WindowEstimator:
        config = self._config
        prior = StatePrior(np.full(3, config.tilt_sigma), 1e-6, velocity_sigma, config.gyro_bias_sigma, config.accel_bias_sigma)
        return WindowEstimator(self._calibration, config, tracks, state, prior, self._scans, depths or self._depths)


def _placed(states: list[KeyframeState], place: DeadReckoning, stamp_ns: int) -> list[KeyframeState]:
    """Return the states moved so that the first is where a place says, with its heading; tilt, which gravity gave, stays."""
    if place.is_origin:
        return states
    T_map_imu, first = place.at(stamp_ns), states[0].T_map_imu
    # The turn about z that brings one attitude nearest to the other.
    a = first[:3, :3] @ T_map_imu[:3, :3].T
    heading = np.arctan2(a[0, 1] - a[1, 0], a[0, 0] + a[1, 1])
    turn = pose(so3_exp(np.array([0.0, 0.0, heading])), np.zeros(3))
    turn[:3, 3] = T_map_imu[:3, 3] - turn[:3, :3] @ first[:3, 3]
    return [KeyframeState(turn @ s.T_map_imu, turn[:3, :3] @ s.velocity, s.gyro_bias, s.accel_bias) for s in states]


def _measurements(preintegration: Preintegration | None) -> gtsam.PreintegratedCombinedMeasurements | None:
    return None if preintegration is None else cast(gtsam.PreintegratedCombinedMeasurements, preintegration.measurements)
