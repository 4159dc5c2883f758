"""First estimate of rotation and time offset between camera and IMU: both see the same angular rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from vli_common.arrays import FloatArray
from vli_common.errors import InputError
from vli_common.geometry import so3_log

SEARCH_S = 1.0
"""Largest time offset that is found."""
_STEP_S = 2e-3
_LONGEST_INTERVAL_S = 0.15
_LEAST_RATE = 0.08
_LEAST_CORRELATION = 0.8
_LEAST_INTERVALS = 20


@dataclass(frozen=True)
class RateAlignment:
    """What the angular rates alone tell.

    Args:
        R_cam_imu: (3, 3).
        gyro_bias: (3,) rad/s.
        timeshift_s: t_imu = t_cam + timeshift.
        correlation: of the rates once aligned, at most 1.
        rate_rms: (3,) rad/s, about the camera's axes.
    """

    R_cam_imu: FloatArray
    gyro_bias: FloatArray
    timeshift_s: float
    correlation: float
    rate_rms: FloatArray


def align_rates(frame_s: FloatArray, R_cam_board: FloatArray, imu_s: FloatArray, gyro: FloatArray) -> RateAlignment:
    """Align the board's turning, as the camera sees it, with the gyroscope.

    For a given time offset the rotation is Wahba's problem on the centred rates (the bias drops out), solved by SVD; the offset
    is the one with the least residual.

    Args:
        frame_s: (F,) seconds.
        R_cam_board: (F, 3, 3).
        imu_s, gyro: (N,) seconds, (N, 3) rad/s.

    Raises:
        InputError: too few neighbouring frames, no rotation, or rates that do not agree at any offset.
    """
    rates = _CameraRates(frame_s, R_cam_board)
    if len(rates.camera) < _LEAST_INTERVALS:
        raise InputError(
            f"the board was found in '{len(rates.camera)}' pairs of consecutive frames, expected at least {_LEAST_INTERVALS}; "
            "keep the whole board in view and the motion smooth"
        )
    rms = np.sqrt(np.mean(rates.camera**2, axis=0))
    if (strength := float(np.linalg.norm(rms))) < _LEAST_RATE:
        raise InputError(
            f"the camera turns by only '{np.rad2deg(strength):.1f}' °/s (rms), expected at least {np.rad2deg(_LEAST_RATE):.0f}; "
            "rotate the sensor briskly about all its axes in front of the board"
        )
    integral = np.vstack([np.zeros(3), np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(imu_s)[:, None], axis=0)])

    def misfit(shift_s: float) -> float:
        return -rates.wahba(imu_s, integral, shift_s)[1]

    grid = np.arange(-SEARCH_S, SEARCH_S + _STEP_S / 2, _STEP_S)
    coarse = float(grid[int(np.argmin([misfit(shift) for shift in grid]))])
    fine = minimize_scalar(misfit, bounds=(coarse - 2 * _STEP_S, coarse + 2 * _STEP_S), method="bounded", options={"xatol": 1e-6})
    shift_s = float(fine.x)
    R_cam_imu, correlation, bias = rates.wahba(imu_s, integral, shift_s)
    if correlation < _LEAST_CORRELATION or abs(coarse) > SEARCH_S - _STEP_S:
        raise InputError(
            f"angular rates of camera and gyroscope correlate by '{correlation:.2f}' at best (offset {shift_s:.3f} s), expected "
            f"at least {_LEAST_CORRELATION}; rotate more, about all axes, and check that both clocks agree to {SEARCH_S:g} s "
            "and --target is the board in view"
        )
    return RateAlignment(R_cam_imu, bias, shift_s, correlation, rms)


class _CameraRates:
    """Mean angular rates of the camera between neighbouring frames."""

    def __init__(self, frame_s: FloatArray, R_cam_board: FloatArray) -> None:
        steps = np.diff(frame_s)
        close = np.flatnonzero((steps > 0) & (steps < _LONGEST_INTERVAL_S))
        self._start, self._end = frame_s[:-1][close], frame_s[1:][close]
        relative = R_cam_board[:-1][close] @ np.swapaxes(R_cam_board[1:][close], 1, 2)
        self.camera: FloatArray = so3_log(relative) / (self._end - self._start)[:, None]

    def wahba(self, imu_s: FloatArray, integral: FloatArray, shift_s: float) -> tuple[FloatArray, float, FloatArray]:
        """Return R_cam_imu, the correlation and the gyroscope's bias for a time offset; −1 where the IMU does not cover it."""
        start, end = self._start + shift_s, self._end + shift_s
        covered = (start >= imu_s[0]) & (end <= imu_s[-1])
        if covered.sum() < max(_LEAST_INTERVALS, 0.5 * len(start)):
            return np.eye(3), -1.0, np.zeros(3)
        ends = (np.stack([np.interp(at[covered], imu_s, column) for column in integral.T], axis=1) for at in (start, end))
        before, after = ends
        imu = (after - before) / (end - start)[covered, None]
        camera = self.camera[covered]
        centred_camera, centred_imu = camera - camera.mean(axis=0), imu - imu.mean(axis=0)
        u, singular, vt = np.linalg.svd(centred_camera.T @ centred_imu)
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
        rotation = (u * sign) @ vt
        size = np.linalg.norm(centred_camera) * np.linalg.norm(centred_imu)
        return rotation, float(singular @ sign) / max(float(size), 1e-12), imu.mean(axis=0) - rotation.T @ camera.mean(axis=0)
