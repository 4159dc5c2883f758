"""Noise of an IMU from a recording at rest: densities, random walks, and the Allan deviation that shows them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import allantools
import numpy as np

from vli_calibration.imu_recording import ImuRecording
from vli_calibration.noise_model import NoiseFit, fit_noise
from vli_calibration.stillness import StillStretch, longest_still_stretch
from vli_common.arrays import FloatArray

SHORTEST_S = 60.0
PRECISION = 0.2
"""Of a random walk, 95 %: worse than this and the recording should have been longer."""
_TAUS_PER_DECADE = 8
_LONGEST_TAU = 8
"""Part of the recording up to which an Allan deviation says something."""
_FULL_RATE_S = 1.0
_UNUSABLE_RATIO = 3.0
"""Of the ends of a random walk's interval: from here on its upper end is written rather than the estimate."""


@dataclass(frozen=True)
class SensorNoise:
    """What was found of the gyroscope or the accelerometer.

    Args:
        fit: all three axes together: what the calibration gets.
        axes: each axis alone.
        walk: random walk to write: the estimate, or the upper end of its interval where the recording does not determine it.
        walk_is_bound: True in the latter case.
        needed_s: recording that would determine it, seconds; 0.0 where this one does.
        taus_s, deviation: overlapping Allan deviation, (N,) and (N, 3).
    """

    fit: NoiseFit
    axes: tuple[NoiseFit, NoiseFit, NoiseFit]
    walk: float
    walk_is_bound: bool
    needed_s: float
    taus_s: FloatArray
    deviation: FloatArray


@dataclass(frozen=True)
class ImuNoise:
    """Noise of a whole IMU, and the stretch at rest that it was measured on."""

    gyro: SensorNoise
    accel: SensorNoise
    rate_hz: float
    stretch: StillStretch

    def section(self) -> dict[str, Any]:
        """Return section ``imu0`` of a calibration file; Kalibr's keys, four significant digits."""
        return {
            "update_rate": _digits(self.rate_hz, 6),
            "accelerometer_noise_density": _digits(self.accel.fit.white),
            "accelerometer_random_walk": _digits(self.accel.walk),
            "gyroscope_noise_density": _digits(self.gyro.fit.white),
            "gyroscope_random_walk": _digits(self.gyro.walk),
        }


def measure_imu_noise(recording: ImuRecording) -> ImuNoise:
    """Return the noise of an IMU that lay still.

    Raises:
        InputError: it did not, or not long enough.
    """
    stretch = longest_still_stretch(recording, SHORTEST_S)
    means, block_s = stretch.block_means()
    gyro, accel = (_measure(means[:, part], block_s, stretch, part) for part in (slice(0, 3), slice(3, 6)))
    return ImuNoise(gyro, accel, recording.rate_hz, stretch)


def allan_deviation(values: FloatArray, period_s: float) -> tuple[FloatArray, FloatArray]:
    """Return τ (N,) and the overlapping Allan deviation (N, axes) of evenly spaced samples (M, axes), by AllanTools."""
    # Overlapping averages at the full rate tell nothing more beyond a second, and take their time.
    size = max(1, int(_FULL_RATE_S / period_s / 20))
    short = _overlapping(values, period_s, period_s, min(_FULL_RATE_S, len(values) * period_s / _LONGEST_TAU))
    count = len(values) // size
    means = values[: count * size].reshape(count, size, -1).mean(axis=1)
    long = _overlapping(means, size * period_s, 1.2 * _FULL_RATE_S, count * size * period_s / _LONGEST_TAU)
    return np.concatenate([short[0], long[0]]), np.vstack([short[1], long[1]])


def _measure(means: FloatArray, block_s: float, stretch: StillStretch, part: slice) -> SensorNoise:
    fit = fit_noise(means, block_s)
    x, y, z = (fit_noise(means[:, [axis]], block_s) for axis in range(3))
    low, high = fit.walk_interval
    is_bound = low <= 0 or high > _UNUSABLE_RATIO * low
    precise = low > 0 and high - low <= 2 * PRECISION * fit.walk
    taus_s, deviation = allan_deviation(stretch.values[:, part], stretch.period_s)
    return SensorNoise(
        fit, (x, y, z), high if is_bound else fit.walk, is_bound, 0.0 if precise else fit.needed_duration_s(PRECISION),
        taus_s, deviation,
    )  # fmt: skip


def _overlapping(values: FloatArray, period_s: float, first_s: float, last_s: float) -> tuple[FloatArray, FloatArray]:
    if last_s < first_s:
        return np.empty(0), np.empty((0, values.shape[1]))
    decades = np.log10(last_s / first_s)
    wanted = np.geomspace(first_s, last_s, max(2, round(_TAUS_PER_DECADE * decades)))
    taus_s = np.unique(np.maximum(1, np.rint(wanted / period_s))) * period_s
    columns = [allantools.oadev(axis, rate=1 / period_s, data_type="freq", taus=taus_s) for axis in values.T]
    return columns[0][0], np.stack([column[1] for column in columns], axis=1)


def _digits(value: float, count: int = 4) -> float:
    return float(f"{value:.{count - 1}e}")
