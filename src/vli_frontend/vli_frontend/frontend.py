"""The front end: long frames, IMU samples and stripes in; tracks, keyframes and preintegration out."""

from __future__ import annotations

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration
from vli_common.errors import CalibrationError
from vli_common.geometry import so3_exp
from vli_common.types import (
    NANOSECONDS,
    Counters,
    FrontEndOutput,
    Image,
    ImuBias,
    ImuSample,
    LaserScan,
    Mode,
    PoseEstimate,
    Tracks,
)
from vli_frontend.config import FrontEndConfig
from vli_frontend.keyframes import FrameVerdict, KeyframeRule
from vli_frontend.motion_hint import MotionHint
from vli_frontend.photometry import Frame, make_frame
from vli_frontend.preintegration import Preintegrator
from vli_frontend.stripe_distance import StripeDistance
from vli_frontend.synchroniser import ImuSegment, ReadyFrame, Synchroniser, seconds_to_ns
from vli_frontend.time_shift import TimeShiftMonitor
from vli_frontend.tracker import Tracker


class FrontEnd:
    """One object a process; :meth:`reset` begins a new session.

    Args:
        calibration: camera; IMU and ``T_cam_imu`` too unless the mode leaves the IMU out.
        config: see :class:`FrontEndConfig`.
        mode: which sensors take part.
        first_id: of the tracks; where the back end may still hold landmarks of another front end, one that it did not use.

    Raises:
        CalibrationError: the mode needs the IMU and the calibration does not have it.
    """

    def __init__(self, calibration: Calibration, config: FrontEndConfig, mode: Mode, first_id: int = 1) -> None:
        self.counters = Counters()
        self._calibration, self._config, self._mode = calibration, config, mode
        wait_ns = seconds_to_ns(config.imu.max_wait_s)
        self._synchroniser = Synchroniser(calibration.timeshift_ns, wait_ns, mode.uses_imu, self.counters)
        self._preintegrator = self._make_preintegrator() if mode.uses_imu else None
        self._time_shift = TimeShiftMonitor(config.time_shift)
        self._tracker = Tracker(calibration.camera, config, self.counters, first_id, calibration.blind_s)
        self._keyframes = KeyframeRule(config.keyframe, calibration.camera.focal_px, mode.uses_laser)
        # Long and short frames alternate: 1.5 frame periods reach the neighbour, and no farther one where the rhythm jitters.
        self._stripes = StripeDistance(round(1.5 * NANOSECONDS / calibration.rate_hz))
        self._motion = MotionHint()
        self._session = 0
        self._previous_ns: int | None = None
        self._gyro_bias = np.zeros(3)
        self._rotation_since_keyframe: FloatArray | None = None

    def reset(self, session: int) -> None:
        """Drop all state and begin another session."""
        self._session = session
        self._synchroniser.clear()
        if self._preintegrator is not None:
            self._preintegrator.reset()
        self._tracker.reset()
        self._keyframes.reset()
        self._stripes.clear()
        self._time_shift.reset()
        self._motion.reset()
        self._previous_ns, self._gyro_bias, self._rotation_since_keyframe = None, np.zeros(3), None

    def set_bias(self, bias: ImuBias) -> None:
        """Predict with this gyro bias from now on, preintegrate with it from the next keyframe on."""
        if self._preintegrator is None or bias.session != self._session:
            self.counters.add("biases_ignored")
            return
        self._gyro_bias = bias.gyro
        self._preintegrator.set_bias(bias)

    def add_pose(self, pose: PoseEstimate) -> None:
        """Take the live pose of a frame, from the back end: its rotation against the gyroscope's tells the time shift."""
        if pose.session != self._session or not (self._mode.uses_imu and self._config.time_shift.online):
            return
        previous_ns = self._time_shift.previous_ns(pose.stamp_ns)
        segment = None if previous_ns is None else self._synchroniser.segment(previous_ns, pose.stamp_ns)
        if segment is not None and segment.longest_gap_ns > seconds_to_ns(self._config.imu.interpolated_gap_s):
            segment = None
        # In odom, which no keyframe makes step.
        R_odom_imu = pose.T_map_odom[:3, :3].T @ pose.T_map_imu[:3, :3]
        self._time_shift.add(pose.stamp_ns, R_odom_imu, segment)

    @property
    def timeshift_ns(self) -> int:
        """The camera–IMU time shift in use: that of the calibration, as corrected."""
        return self._synchroniser.timeshift_ns

    @property
    def hint(self) -> str:
        """What to do, or to change in the calibration, in words; empty where nothing is wrong."""
        return self._motion.text or self._time_shift_hint

    @property
    def _time_shift_hint(self) -> str:
        wrong_ns = self.timeshift_ns - self._calibration.timeshift_ns
        if wrong_ns == 0:
            return ""
        return (
            f"the camera's clock is {wrong_ns * 1e-6:+.1f} ms off the calibration and is corrected; "
            f"set cam0.timeshift_cam_imu to {self.timeshift_ns / NANOSECONDS:.4f}"
        )

    def add_scan(self, scan: LaserScan) -> None:
        """Take the stripe of a short frame."""
        if scan.session != self._session:
            self.counters.add("scans_of_other_session")
        elif self._mode.uses_laser:
            self._stripes.add(scan)

    def add_imu(self, sample: ImuSample) -> list[FrontEndOutput]:
        """Take an IMU sample; return the frames it completes."""
        if self._mode.uses_imu and self._synchroniser.add_imu(sample):
            return self._release()
        return []

    def prepare(self, image: Image) -> Frame:
        """Return what following a long frame needs of its image alone; changes nothing, so that another thread may ask ahead."""
        return make_frame(image, self._config.klt.normalisation_px)

    def add_image(self, image: Image, prepared: Frame | None = None) -> list[FrontEndOutput]:
        """Take a long frame; return those that are complete.

        Args:
            image: the long frame.
            prepared: of the image, see :meth:`prepare`; made here where it is None.
        """
        camera = self._calibration.camera
        if image.session != self._session:
            self.counters.add("frames_of_other_session")
        elif image.pixels.shape[:2] != (camera.height, camera.width):
            self.counters.add("frames_of_wrong_size")
        elif self._synchroniser.add_frame(prepared or self.prepare(image)):
            return self._release()
        return []

    def _release(self) -> list[FrontEndOutput]:
        outputs = []
        while isinstance(ready := self._synchroniser.next(), ReadyFrame):
            outputs.append(self._process(ready))
        return outputs

    def _process(self, ready: ReadyFrame) -> FrontEndOutput:
        """Follow the tracks, judge the frame, detect new points on a keyframe, preintegrate."""
        frame, stamp_ns = ready.frame, ready.frame.stamp_ns
        segment = self._segment(stamp_ns) if ready.covered else None
        rotation = self._rotation(segment)
        before = len(self._tracker.tracks)
        self._tracker.follow(frame, (stamp_ns - (self._previous_ns or 0)) / NANOSECONDS, rotation)
        if self._previous_ns is not None:
            self._motion.add(before, len(self._tracker.tracks), self._motion_px(stamp_ns - self._previous_ns, rotation))
        verdict = self._judge(stamp_ns, rotation, segment)
        preintegration = None
        if self._preintegrator is not None and ready.covered:
            preintegration = self._preintegrator.to(stamp_ns, self._session)
        if verdict.keyframe:
            self._tracker.replenish(frame)
            self._begin_interval(stamp_ns, verdict.stationary)
        self._previous_ns = stamp_ns
        return FrontEndOutput(self._tracks(stamp_ns, verdict), preintegration)

    def _motion_px(self, step_ns: int, rotation: FloatArray | None) -> float:
        """Return how far the image has moved since the frame before: by its tracks, or the gyroscope where none is left."""
        focal_px, tracks = self._calibration.camera.focal_px, self._tracker.tracks
        if len(tracks):
            return float(np.median(np.linalg.norm(tracks.velocity, axis=1))) * focal_px * step_ns / NANOSECONDS
        return 0.0 if rotation is None else float(np.linalg.norm(rotation[:2, 2])) * focal_px

    def _segment(self, stamp_ns: int) -> ImuSegment | None:
        """Return the IMU since the frame before; for the first frame, that of one frame period."""
        begin_ns = self._previous_ns
        if begin_ns is None:
            begin_ns = stamp_ns - round(2 * NANOSECONDS / self._calibration.rate_hz)
        segment = self._synchroniser.segment(begin_ns, stamp_ns)
        if segment is None or segment.longest_gap_ns > seconds_to_ns(self._config.imu.interpolated_gap_s):
            return None
        return segment

    def _rotation(self, segment: ImuSegment | None) -> FloatArray | None:
        """Return the rotation (3, 3) from the camera at the frame before to the camera now."""
        T_cam_imu = self._calibration.T_cam_imu
        if segment is None or T_cam_imu is None:
            return None
        angle = (segment.mean_rate - self._gyro_bias) * (int(segment.stamps[-1] - segment.stamps[0]) / NANOSECONDS)
        R_cam_imu = T_cam_imu[:3, :3]
        result: FloatArray = R_cam_imu @ so3_exp(-angle) @ R_cam_imu.T
        return result

    def _judge(self, stamp_ns: int, rotation: FloatArray | None, segment: ImuSegment | None) -> FrameVerdict:
        since_keyframe = self._rotation_since_keyframe
        self._rotation_since_keyframe = None if rotation is None or since_keyframe is None else rotation @ since_keyframe
        tracks = self._tracker.tracks
        rate = None if segment is None else segment.mean_rate - self._gyro_bias
        verdict = self._keyframes.judge(stamp_ns, tracks.ids, tracks.rays, self._rotation_since_keyframe, rate)
        if verdict.keyframe:
            self.counters.add(f"keyframes: {verdict.reason}")
        return verdict

    def _begin_interval(self, stamp_ns: int, stationary: bool) -> None:
        self._correct_time_shift()
        tracks = self._tracker.tracks
        self._keyframes.accept(stamp_ns, stationary, tracks.ids, tracks.rays)
        self._rotation_since_keyframe = np.eye(3)
        if self._preintegrator is not None:
            self._preintegrator.start(stamp_ns)

    def _correct_time_shift(self) -> None:
        """Change the time shift, at a keyframe only: within an interval all measurements share one clock."""
        correction_ns = seconds_to_ns(self._time_shift.correction_s())
        if correction_ns == 0:
            return
        largest_ns = seconds_to_ns(self._config.time_shift.largest_s)
        wanted_ns = self.timeshift_ns + correction_ns - self._calibration.timeshift_ns
        self._synchroniser.timeshift_ns = self._calibration.timeshift_ns + max(-largest_ns, min(largest_ns, wanted_ns))
        self._time_shift.reset()
        self.counters.add("time_shift_corrections")

    def _tracks(self, stamp_ns: int, verdict: FrameVerdict) -> Tracks:
        """Return the tracks as they are now; nothing in it changes later."""
        table = self._tracker.tracks
        stripe_px = self._stripes.measure(stamp_ns, table.pixels)
        return Tracks(
            stamp_ns,
            verdict.keyframe,
            verdict.stationary,
            ids=table.ids.copy(),
            pixels=table.pixels.copy(),
            rays=table.rays.copy(),
            velocity=table.velocity.copy(),
            sigma_px=self._tracker.sigma_px,
            stripe_px=stripe_px,
            flags=table.flags.copy(),
            session=self._session,
        )

    def _make_preintegrator(self) -> Preintegrator:
        imu = self._calibration.imu
        if imu is None or self._calibration.T_cam_imu is None:
            problem = f"mode '{self._mode.value}' needs imu0 and cam0.T_cam_imu; run 'vli calibrate imu-camera', or use --mode vl"
            raise CalibrationError("as given", [problem])
        return Preintegrator(imu, self._config.imu, self._synchroniser, self.counters)
