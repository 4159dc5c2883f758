"""The IMU: units, rate, noise, clipping, and whether its clock is the camera's."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from vli_bringup.diagnosis.findings import Finding, Level
from vli_bringup.diagnosis.stamps import check_stamps
from vli_bringup.input_checks import Beginning, check_accelerometer_unit, check_gyro_unit, check_overlap
from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration, ImuCalibration
from vli_common.errors import InputError
from vli_common.types import EncodedImage, ImuSample

_QUIET_S = 1.0
_NOISY = 3.0
"""Times the calibrated noise, in the quietest second, that is worth a word."""
_CLIPPED = 5


class ImuCheck:
    """IMU samples as they come.

    Args:
        calibration: None leaves rate and noise out.
        topic: of the IMU, for the texts.
    """

    def __init__(self, calibration: Calibration | None, topic: str) -> None:
        self._calibration = calibration.imu if calibration else None
        self._topic = topic
        self._images: list[int] = []
        self._samples: list[ImuSample] = []

    def add(self, item: EncodedImage | ImuSample) -> None:
        """Take a sample; of images only the stamp matters."""
        if isinstance(item, ImuSample):
            self._samples.append(item)
        else:
            self._images.append(item.stamp_ns)

    def findings(self) -> Iterator[Finding]:
        """Say what was found."""
        stamps = [sample.stamp_ns for sample in self._samples]
        yield from check_stamps("IMU", stamps, self._calibration.rate_hz if self._calibration else None, "imu0.update_rate")
        if len(stamps) < 2:
            return
        data = self._arrays()
        if self._images:
            yield _verdict(lambda: check_overlap(data, self._topic), "clocks", "IMU and camera overlap in time")
        yield _verdict(lambda: check_accelerometer_unit(data.accel), "IMU", "measures gravity in m/s²")
        yield _verdict(lambda: check_gyro_unit(data), "IMU", "its rates agree with how gravity turns")
        for name, values in (("gyro", data.gyro), ("accelerometer", data.accel)):
            yield from _check_clipping(name, values)
        if self._calibration is not None:
            yield from _check_noise(data, self._calibration)

    def _arrays(self) -> Beginning:
        samples = self._samples
        return Beginning(
            np.array(self._images, dtype=np.int64),
            np.array([sample.stamp_ns for sample in samples], dtype=np.int64),
            np.array([sample.gyro for sample in samples]),
            np.array([sample.accel for sample in samples]),
        )


def quietest_noise(values: FloatArray, rate_hz: float) -> float:
    """Return the noise density (unit/√Hz) of the quietest second of (N, 3) samples, from second differences.

    Those leave a hand's slow motion out; what tremor is left makes the figure an upper bound.
    """
    length = max(round(_QUIET_S * rate_hz), 8)
    steps = np.diff(values, n=2, axis=0) / np.sqrt(6)
    count = max(len(steps) // length, 1)
    spread = [float(np.sqrt((part**2).mean())) for part in np.array_split(steps, count)]
    return min(spread) / float(np.sqrt(rate_hz))


def _check_noise(data: Beginning, imu: ImuCalibration) -> Iterator[Finding]:
    noises = (("gyro", data.gyro, imu.gyroscope_noise_density), ("accelerometer", data.accel, imu.accelerometer_noise_density))
    for name, values, density in noises:
        ratio = quietest_noise(values, imu.rate_hz) / density
        if ratio > _NOISY:
            text = (
                f"the {name} is {ratio:.0f} times as noisy as calibrated, even in its quietest second; vibration, or the wrong "
            )
            yield Finding(Level.WARNING, "IMU", text + "imu0: measure it with 'vli calibrate imu'")
        else:
            yield Finding(Level.GOOD, "IMU", f"{name} noise {ratio:.1f} times the calibrated one in the quietest second")


def _check_clipping(name: str, values: FloatArray) -> Iterator[Finding]:
    """Warn where an axis sits at its extreme for several samples: a range that is too small."""
    for axis, column in zip("xyz", values.T, strict=True):
        for limit in (column.max(), column.min()):
            at_limit = int((column == limit).sum())
            if at_limit >= _CLIPPED and np.ptp(column) > 0 and abs(limit) > 0.5 * np.abs(column).max():
                text = f"{name} {axis} reads exactly {limit:.4g} {at_limit} times, its extreme: clipped? widen its range"
                yield Finding(Level.WARNING, "IMU", text)


def _verdict(check: Callable[[], None], subject: str, good: str) -> Finding:
    try:
        check()
    except InputError as error:
        return Finding(Level.PROBLEM, subject, str(error))
    return Finding(Level.GOOD, subject, good)
