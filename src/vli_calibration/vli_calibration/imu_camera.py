"""Rotation, translation and time offset between camera and IMU, from a board that moves past a moving sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vli_calibration.board_track import BoardTrack
from vli_calibration.imu_camera_alignment import RateAlignment, align_rates
from vli_calibration.imu_camera_graph import GRAVITY_SIGMA, NOMINAL_GRAVITY, Batch
from vli_calibration.imu_camera_solution import Solution
from vli_calibration.imu_camera_states import FrameStates, RigState
from vli_calibration.imu_intervals import ImuIntervals
from vli_calibration.imu_recording import ImuRecording
from vli_common.arrays import FloatArray
from vli_common.calibration import ImuCalibration
from vli_common.errors import InputError
from vli_common.geometry import inverse, pose, rotation_between

_ROUNDS = 8
_TIME_CONVERGED_S = 1e-5
_GRAVITY_CONVERGED = 1e-3
_GRAVITY_HELD = 1e-5
"""In the first round, while attitudes still turn."""
_FRAME_GATE = 40.0
"""χ² of six from which on a frame's board is a wrong one: never by chance."""
_MARGIN_S = 0.02
LEAST_FRAMES = 40
_SIGMAS_95 = 1.959964


@dataclass(frozen=True)
class ImuCameraFit:
    """The calibration and what it is worth.

    Args:
        T_cam_imu: (4, 4).
        timeshift_s: t_imu = t_cam + timeshift.
        gravity: m/s², as this accelerometer measures it.
        rotation_half_width: (3,) radians, 95 %, about the camera's axes.
        translation_half_width: (3,) metres, 95 %, along the camera's axes.
        timeshift_half_width_s: 95 %.
        consistency: √(χ² / degrees of freedom); the half-widths include it where it is above one.
        alignment: the first estimate.
        rig, frames: all states, at the camera's times.
        track: the frames that were used.
        outliers: frames left out because their board did not fit.
        frame_seconds: (F,) the frames' times.
        rates: (F − 1, 3) mean angular rate of ``imu_link`` between frames, rad/s.
        gyro_residuals, accel_residuals: (F − 1, 3) what the IMU measured between two frames minus the solution; NaN where the
            frames are too far apart.
    """

    T_cam_imu: FloatArray
    timeshift_s: float
    gravity: float
    rotation_half_width: FloatArray
    translation_half_width: FloatArray
    timeshift_half_width_s: float
    consistency: float
    alignment: RateAlignment
    rig: RigState
    frames: FrameStates
    track: BoardTrack
    outliers: int
    frame_seconds: FloatArray
    rates: FloatArray
    gyro_residuals: FloatArray
    accel_residuals: FloatArray

    @property
    def board_poses(self) -> FloatArray:
        """(F, 4, 4) where the solution expects the board."""
        T_board = pose(self.rig.R_world_board, np.zeros(3))
        result: FloatArray = self.T_cam_imu @ inverse(self.frames.T_world_imu) @ T_board
        return result


def fit_imu_camera(track: BoardTrack, recording: ImuRecording, noise: ImuCalibration) -> ImuCameraFit:
    """Estimate T_cam_imu and the time offset with everything else that the motion depends on.

    Angular rates first (:mod:`vli_calibration.imu_camera_alignment`), then the batch of
    :mod:`vli_calibration.imu_camera_graph`, preintegrated anew until the time offset stays.

    Raises:
        InputError: too few frames, no motion, no common time, rates that do not agree.
    """
    intervals = ImuIntervals(recording, noise)
    _check_overlap(intervals, track)
    seconds = intervals.camera_seconds(track)
    alignment = align_rates(seconds, track.T_cam_board[:, :3, :3], recording.seconds, recording.values[:, :3])
    track = _covered(track, intervals, alignment.timeshift_s)
    rig, frames = _first_guess(track, intervals, alignment)
    solution = _converged(track, intervals, rig, frames, (_GRAVITY_HELD,))
    fits = Batch(track, intervals).chi_squared(solution) < _FRAME_GATE * max(1.0, _consistency(solution, len(track)) ** 2)
    if not fits.all():
        track, states = track.select(fits), solution.frames
        frames = FrameStates(states.T_world_imu[fits], states.velocity[fits], states.biases[fits])
        solution = _converged(track, intervals, solution.rig, frames)
    return _fit(solution, track, intervals, alignment, int((~fits).sum()))


def _check_overlap(intervals: ImuIntervals, track: BoardTrack) -> None:
    if len(track) < LEAST_FRAMES:
        raise InputError(
            f"the board was found in '{len(track)}' frames, expected at least {LEAST_FRAMES}: keep it in view, in focus and lit, "
            "and check --target"
        )
    seconds = intervals.camera_seconds(track)
    if not intervals.covers(seconds).any():
        raise InputError(
            f"IMU and camera share no time: the camera's stamps begin '{seconds[0]:.3f}' s after the IMU's first sample and end "
            f"at {seconds[-1]:.3f} s; expected both in one clock: fix the drivers' stamps and record again"
        )


def _covered(track: BoardTrack, intervals: ImuIntervals, timeshift_s: float) -> BoardTrack:
    """Return the frames whose time lies well within the IMU's samples."""
    inside = intervals.covers(intervals.camera_seconds(track) + timeshift_s, _MARGIN_S)
    if inside.sum() < LEAST_FRAMES:
        raise InputError(
            f"the IMU covers '{int(inside.sum())}' of {len(track)} frames with a board, expected at least {LEAST_FRAMES}; "
            "record both for the same time"
        )
    return track.select(inside)


def _first_guess(track: BoardTrack, intervals: ImuIntervals, alignment: RateAlignment) -> tuple[RigState, FrameStates]:
    """Return states from the camera's poses: IMU and camera in one place, gravity from the mean specific force."""
    seconds = intervals.camera_seconds(track)
    force = intervals.at(seconds + alignment.timeshift_s)[:, 3:]
    T_cam_imu = pose(alignment.R_cam_imu, np.zeros(3))
    T_board_imu = inverse(track.T_cam_board) @ T_cam_imu
    upwards = np.einsum("nij,nj->ni", T_board_imu[:, :3, :3], force).mean(axis=0)
    R_world_board = rotation_between(upwards, np.array([0.0, 0.0, 1.0]))
    T_world_imu = pose(R_world_board, np.zeros(3)) @ T_board_imu
    velocity = np.gradient(T_world_imu[:, :3, 3], seconds, axis=0)
    biases = np.broadcast_to(np.concatenate([np.zeros(3), alignment.gyro_bias]), (len(track), 6)).copy()
    return RigState(T_cam_imu, R_world_board, alignment.timeshift_s, NOMINAL_GRAVITY), FrameStates(T_world_imu, velocity, biases)


def _converged(
    track: BoardTrack, intervals: ImuIntervals, rig: RigState, frames: FrameStates, first: tuple[float, ...] = ()
) -> Solution:
    """Solve until neither time offset nor gravity change what was preintegrated."""
    batch = Batch(track, intervals)
    for gravity_sigma in (*first, *(GRAVITY_SIGMA,) * _ROUNDS):
        try:
            solution = batch.solve(rig, frames, gravity_sigma)
        except RuntimeError as error:
            raise InputError(
                "the motion does not determine camera and IMU; rotate the sensor about all three axes and move it to and fro "
                f"in front of the board (GTSAM: {str(error).splitlines()[0]})"
            ) from error
        rig, frames = solution.rig, solution.frames
        settled = abs(solution.timeshift_step_s) < _TIME_CONVERGED_S and abs(solution.gravity_step) < _GRAVITY_CONVERGED
        if settled and gravity_sigma == GRAVITY_SIGMA:
            break
    return solution


def _consistency(solution: Solution, count: int) -> float:
    """Return √(χ²/dof): 15 rows an interval and six a frame, 15 unknowns a frame."""
    degrees = 15 * (count - 1) + 6 * count - 15 * count
    return float(np.sqrt(2 * solution.graph.error(solution.values) / max(degrees, 1)))


def _fit(solution: Solution, track: BoardTrack, intervals: ImuIntervals, alignment: RateAlignment, outliers: int) -> ImuCameraFit:
    rig, frames = solution.rig, solution.frames
    rates, gyro, accel = intervals.residuals(track, rig, frames)
    consistency = _consistency(solution, len(track))
    covariance = max(1.0, consistency) ** 2 * solution.covariance()
    R = rig.T_cam_imu[:3, :3]
    rotation, translation = (np.sqrt(np.diag(R @ covariance[part, part] @ R.T)) for part in (slice(0, 3), slice(3, 6)))
    return ImuCameraFit(
        T_cam_imu=rig.T_cam_imu,
        timeshift_s=rig.timeshift_s,
        gravity=rig.gravity,
        rotation_half_width=_SIGMAS_95 * rotation,
        translation_half_width=_SIGMAS_95 * translation,
        timeshift_half_width_s=_SIGMAS_95 * float(np.sqrt(covariance[6, 6])),
        consistency=consistency,
        alignment=alignment,
        rig=rig,
        frames=frames,
        track=track,
        outliers=outliers,
        frame_seconds=intervals.camera_seconds(track) - intervals.camera_seconds(track)[0],
        rates=rates,
        gyro_residuals=gyro,
        accel_residuals=accel,
    )
