"""What the IMU measured between the frames of a camera, for a time offset between the two."""

from __future__ import annotations

import gtsam
import numpy as np

from vli_calibration.board_track import BoardTrack
from vli_calibration.imu_camera_states import FrameStates, RigState
from vli_calibration.imu_recording import ImuRecording
from vli_common.arrays import BoolArray, FloatArray
from vli_common.calibration import ImuCalibration
from vli_common.geometry import so3_exp, so3_log
from vli_common.types import NANOSECONDS

LONGEST_STEP_S = 1.0
"""Frames farther apart are not joined: the IMU alone says little over such a time."""
_INTEGRATION_SIGMA = 1e-6


class ImuIntervals:
    """Preintegrated measurements between frames, for a time offset and a gravity.

    Args:
        recording: samples at rates that cover the frames.
        noise: densities.
    """

    def __init__(self, recording: ImuRecording, noise: ImuCalibration) -> None:
        self._seconds = recording.seconds
        self._values = recording.values
        self._origin_ns = int(recording.stamps_ns[0])
        self._noise = noise

    def camera_seconds(self, track: BoardTrack) -> FloatArray:
        """Return the camera's stamps (F,) in seconds since the IMU's first sample."""
        result: FloatArray = (track.stamps_ns - self._origin_ns) / NANOSECONDS
        return result

    def at(self, seconds: FloatArray) -> FloatArray:
        """Return the measurements (F, 6) at instants, interpolated between samples."""
        return np.stack([np.interp(seconds, self._seconds, column) for column in self._values.T], axis=1)

    def covers(self, seconds: FloatArray, margin_s: float = 0.0) -> BoolArray:
        """Return which instants (F,) the samples cover."""
        result: BoolArray = (seconds >= self._seconds[0] + margin_s) & (seconds <= self._seconds[-1] - margin_s)
        return result

    def params(self, gravity: float) -> gtsam.PreintegrationCombinedParams:
        """Return GTSAM's noise parameters, gravity along −z."""
        params = gtsam.PreintegrationCombinedParams.MakeSharedU(gravity)
        params.setAccelerometerCovariance(np.eye(3) * self._noise.accelerometer_noise_density**2)
        params.setGyroscopeCovariance(np.eye(3) * self._noise.gyroscope_noise_density**2)
        params.setBiasAccCovariance(np.eye(3) * self._noise.accelerometer_random_walk**2)
        params.setBiasOmegaCovariance(np.eye(3) * self._noise.gyroscope_random_walk**2)
        params.setIntegrationCovariance(np.eye(3) * _INTEGRATION_SIGMA**2)
        return params

    def preintegrate(
        self, start_s: float, end_s: float, bias: FloatArray, params: gtsam.PreintegrationCombinedParams
    ) -> gtsam.PreintegratedCombinedMeasurements:
        """Return what the IMU measured from one instant to another; each step takes the mean of its two ends.

        GTSAM turns a step's force by the attitude at its start. The mean belongs to the middle, half a step of turning later:
        left out, that is the same as an accelerometer that lags by half a sample.
        """
        first, last = np.searchsorted(self._seconds, (start_s, end_s), side="right")
        last -= self._seconds[last - 1] == end_s
        seconds = np.concatenate([[start_s], self._seconds[first:last], [end_s]])
        ends = self.at(np.array([start_s, end_s]))
        values = np.vstack([ends[:1], self._values[first:last], ends[1:]])
        means, steps = 0.5 * (values[1:] + values[:-1]), np.diff(seconds)
        halfway = so3_exp(0.5 * steps[:, None] * (means[:, :3] - bias[3:]))
        force = np.einsum("nij,nj->ni", halfway, means[:, 3:] - bias[:3]) + bias[:3]
        measured = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))
        for mean, accel, step in zip(means, force, steps.tolist(), strict=True):
            measured.integrateMeasurement(accel, mean[:3], step)
        return measured

    def residuals(self, track: BoardTrack, rig: RigState, frames: FrameStates) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return mean rates between frames, and measured minus solved: rates, forces; (F − 1, 3) each, NaN over long gaps."""
        seconds = self.camera_seconds(track) + rig.timeshift_s
        steps = np.diff(seconds)[:, None]
        R, params = frames.T_world_imu[:, :3, :3], self.params(rig.gravity)
        rates = so3_log(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / steps
        gyro, accel = np.full_like(rates, np.nan), np.full_like(rates, np.nan)
        for index in np.flatnonzero(steps[:, 0] <= LONGEST_STEP_S):
            bias = frames.biases[index]
            measured = self.preintegrate(float(seconds[index]), float(seconds[index + 1]), bias, params)
            start = gtsam.NavState(gtsam.Pose3(frames.T_world_imu[index]), frames.velocity[index])
            end = measured.predict(start, gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))
            gyro[index] = so3_log(R[index + 1].T @ end.attitude().matrix())
            accel[index] = R[index].T @ (end.velocity() - frames.velocity[index + 1])
        return rates, gyro / steps, accel / steps
