"""IMU preintegration from the last keyframe to each long frame (Forster et al., 2017), by GTSAM."""

from __future__ import annotations

import gtsam
import numpy as np

from vli_common.arrays import FloatArray
from vli_common.calibration import ImuCalibration
from vli_common.geometry import so3_exp
from vli_common.types import Counters, ImuBias, Preintegration
from vli_frontend.config import ImuConfig
from vli_frontend.imu_gaps import HISTORY, HOLE, gap_variance, period_ns
from vli_frontend.imu_noise import NoiseMonitor
from vli_frontend.synchroniser import ImuSegment, Synchroniser, seconds_to_ns

GRAVITY = 9.81
_INTEGRATION_SIGMA = 1e-5
"""Of the position per √s, metres: what integrating in steps leaves out."""


def variances(imu: ImuCalibration, config: ImuConfig) -> FloatArray:
    """Return the continuous-time variances (2,) of gyroscope and accelerometer."""
    accelerometer = max(imu.accelerometer_noise_density, config.accelerometer_noise)
    gyroscope = config.gyroscope_factor * imu.gyroscope_noise_density
    return np.array([gyroscope, accelerometer]) ** 2


def combined_params(imu: ImuCalibration, config: ImuConfig) -> gtsam.PreintegrationCombinedParams:
    """Return GTSAM's noise parameters (continuous-time variances) for a calibrated IMU, gravity along −z.

    Args:
        imu: noise of the calibration.
        config: factors on it.
    """
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY)
    _set_noise(params, variances(imu, config))
    params.setBiasAccCovariance(np.eye(3) * (config.walk_factor * imu.accelerometer_random_walk) ** 2)
    params.setBiasOmegaCovariance(np.eye(3) * (config.walk_factor * imu.gyroscope_random_walk) ** 2)
    params.setIntegrationCovariance(np.eye(3) * _INTEGRATION_SIGMA**2)
    return params


def _set_noise(params: gtsam.PreintegrationCombinedParams, variance: FloatArray) -> None:
    params.setGyroscopeCovariance(np.eye(3) * variance[0])
    params.setAccelerometerCovariance(np.eye(3) * variance[1])


_LEAST_STEPS = 4
_EVEN = 1.5
"""Longest over shortest step up to which samples count as even."""


class Preintegrator:
    """Measurements between the last keyframe and each frame after it.

    Samples are instants: each step takes the signal's mean over it, the first and the last step end at the frames' own stamps.
    Every answer is integrated afresh (1.5 µs a sample), so that it may be kept. Noise is that of the calibration, or what the
    samples show where that is clearly more; across a gap, what interpolating costs (:mod:`vli_frontend.imu_gaps`) comes on top.

    Args:
        imu: noise of the calibration.
        config: factors on it; how gaps are treated.
        synchroniser: holds the samples.
        counters: of the stage.
    """

    def __init__(self, imu: ImuCalibration, config: ImuConfig, synchroniser: Synchroniser, counters: Counters) -> None:
        self._noise, self._config = NoiseMonitor(imu), config
        self._params = combined_params(imu, config)
        self._longest_ns = seconds_to_ns(config.longest_gap_s)
        self._synchroniser = synchroniser
        self._counters = counters
        self._bias, self._interval_bias = gtsam.imuBias.ConstantBias(), gtsam.imuBias.ConstantBias()
        self._from_ns: int | None = None
        self._hole_ns: float | None = None
        """Interval between samples that is a gap, once the interval's first frame has asked."""

    def set_bias(self, bias: ImuBias) -> None:
        """Use this bias from the next keyframe on."""
        self._bias = gtsam.imuBias.ConstantBias(bias.accel, bias.gyro)

    def start(self, keyframe_ns: int) -> None:
        """Begin a new interval at a keyframe (camera clock)."""
        ended = None if self._from_ns is None else self._synchroniser.segment(self._from_ns, keyframe_ns)
        if ended is not None and self._noise.update(ended):
            self._params = combined_params(self._noise.imu, self._config)
            self._counters.add("imu_noise_changes")
        self._from_ns, self._interval_bias, self._hole_ns = keyframe_ns, self._bias, None

    def reset(self) -> None:
        """Forget keyframe and bias: a new session begins."""
        self._from_ns, self._bias = None, gtsam.imuBias.ConstantBias()

    def to(self, stamp_ns: int, session: int) -> Preintegration | None:
        """Return the measurements from the last keyframe to a frame (camera clock), or None where the IMU has no answer."""
        if self._from_ns is None:
            return None
        segment = self._synchroniser.segment(self._from_ns, stamp_ns)
        if segment is None or segment.longest_gap_ns > self._longest_ns:
            self._counters.add("intervals_without_imu")
            return None
        gaps = self._gaps(segment)
        inflate = max((float((variance / self._variance).max()) for variance in gaps.values()), default=1.0)
        if inflate > 1.0:
            self._counters.add("intervals_inflated")
        return Preintegration(stamp_ns, self._from_ns, self._integrate(segment, gaps), inflate, session)

    @property
    def _variance(self) -> FloatArray:
        return variances(self._noise.imu, self._config)

    def _gaps(self, segment: ImuSegment) -> dict[int, FloatArray]:
        """Return the variances (2,) of gyroscope and accelerometer across each length of gap that the segment rests on."""
        newest_ns = int(segment.stamps[-1])
        if self._hole_ns is None:
            self._hole_ns = HOLE * period_ns(self._synchroniser.imu.newest(HISTORY, newest_ns)[0])
        longest = segment.gaps_ns[segment.gaps_ns > self._hole_ns]
        if not len(longest):
            return {}
        stamps, values = self._synchroniser.imu.newest(HISTORY, newest_ns)
        return {int(gap): self._variance + gap_variance(stamps, values, int(gap)) for gap in np.unique(longest)}

    def _integrate(self, segment: ImuSegment, gaps: dict[int, FloatArray]) -> gtsam.PreintegratedCombinedMeasurements:
        params = combined_params(self._noise.imu, self._config) if gaps else self._params
        measurements = gtsam.PreintegratedCombinedMeasurements(params, self._interval_bias)
        stamps_s = (segment.stamps - segment.stamps[0]) * 1e-9
        steps = np.diff(stamps_s)
        means = step_means(np.concatenate([segment.gyro, segment.accel], axis=1), stamps_s)
        gyro = means[:, :3]
        accel = force_at_start(means[:, 3:], gyro, steps, self._interval_bias)
        for a, w, dt, gap in zip(accel, gyro, steps.tolist(), segment.gaps_ns.tolist(), strict=True):
            if gaps:
                # GTSAM reads the noise at each step.
                _set_noise(params, gaps.get(gap, self._variance))
            measurements.integrateMeasurement(a, w, dt)
        return measurements


def force_at_start(accel: FloatArray, gyro: FloatArray, steps: FloatArray, bias: gtsam.imuBias.ConstantBias) -> FloatArray:
    """Return the mean force (N, 3) of each step as seen in the attitude at its start, with the bias as it was.

    GTSAM turns the force of a step by that attitude, while the mean is that of the middle: taken as it is, gravity would lag the
    rotation by half a sample.

    Args:
        accel, gyro: (N, 3) means over the steps, bias included.
        steps: (N,) seconds.
        bias: that the preintegration subtracts.
    """
    half_turns = so3_exp(0.5 * steps[:, None] * (gyro - bias.gyroscope()))
    force: FloatArray = np.einsum("nij,nj->ni", half_turns, accel - bias.accelerometer())
    return force + bias.accelerometer()


def step_means(values: FloatArray, stamps_s: FloatArray) -> FloatArray:
    """Return the mean of a signal over each step between its samples: the trapezoidal rule less h²/12 times the curvature.

    At 200 Hz the rule alone takes 1 % off a hand's tremor of 10 Hz, and so off the scale of a path that the IMU measures. Where
    samples are few or a gap lies between them, or at the ends, the curvature is not known: the rule stays.

    Args:
        values: (M, K); the first and the last are interpolated, the others samples.
        stamps_s: (M,) ascending.
    """
    steps = np.diff(stamps_s)
    means: FloatArray = 0.5 * (values[1:] + values[:-1])
    inner = steps[1:-1]
    if len(inner) < _LEAST_STEPS or steps.max() > _EVEN * inner.min():
        return means
    slopes = np.diff(values[1:-1], axis=0) / inner[:, None]
    curvature = np.diff(slopes, axis=0) / (0.5 * (inner[1:] + inner[:-1]))[:, None]
    # One for each sample, the outer ones as their neighbours; then the mean over each step.
    at_samples = curvature.take(np.arange(-2, len(curvature) + 2), axis=0, mode="clip")
    return means - (steps**2)[:, None] / 12.0 * 0.5 * (at_samples[1:] + at_samples[:-1])
