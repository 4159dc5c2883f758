"""The IMU of a bag as arrays: stamps checked, rate measured, gaps named."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vli_calibration.progress import progress
from vli_common.arrays import FloatArray, IntArray
from vli_common.errors import InputError
from vli_common.types import NANOSECONDS
from vli_driver.bag import DEFAULT_IMU_TOPIC, BagReader, BagTopics

_BLOCK = 10_000
_MOST_SAMPLES = 8_000_000
"""Beyond these (0.5 GB, 11 hours at 200 Hz) neighbours are averaged."""
_MISSING = 1.5
"""Sampling periods between two stamps from which on a sample is missing."""
_FEWEST = 10


@dataclass(frozen=True)
class ImuRecording:
    """All samples of an IMU in order of time.

    Args:
        stamps_ns: (N,) int64, strictly increasing.
        values: (N, 6) angular rate, rad/s, and specific force, m/s².
        rate_hz: samples a second as the sensor gave them, from the median period.
        dropped: samples left out because their stamp did not increase, or a value was not finite.
    """

    stamps_ns: IntArray
    values: FloatArray
    rate_hz: float
    dropped: int = 0

    @property
    def seconds(self) -> FloatArray:
        """Time (N,) since the first sample."""
        result: FloatArray = (self.stamps_ns - self.stamps_ns[0]) / NANOSECONDS
        return result

    @property
    def period_s(self) -> float:
        """Median time between two rows of ``values``: 1 / rate, longer where neighbours were averaged."""
        return float(np.median(np.diff(self.stamps_ns))) / NANOSECONDS

    def gaps(self) -> list[tuple[float, float]]:
        """Return (start, length) in seconds of every place where samples are missing."""
        steps = np.diff(self.stamps_ns) / NANOSECONDS
        places = np.flatnonzero(steps > _MISSING * self.period_s)
        return [(float(self.seconds[place]), float(steps[place])) for place in places]


def read_imu_recording(path: Path, topic: str = DEFAULT_IMU_TOPIC) -> ImuRecording:
    """Read the IMU of a bag, images or not; memory is bounded however long it is.

    Raises:
        InputError: no bag, no IMU in it, or hardly a sample.
    """
    reader = BagReader(path, BagTopics(imu=topic, image_required=False))
    collector = _Collector()
    blocks = -(-reader.count(reader.imu_topic) // _BLOCK)
    for stamps_ns, gyro, accel in progress(reader.imu_blocks(_BLOCK), blocks, "reading the IMU"):
        collector.add(stamps_ns, np.hstack([gyro, accel]))
    return collector.recording(f"topic '{reader.imu_topic}' in '{path}'")


def make_recording(stamps_ns: IntArray, values: FloatArray, source: str = "the IMU") -> ImuRecording:
    """Return the recording of samples in the order in which they came.

    Args:
        stamps_ns, values: see :class:`ImuRecording`, unchecked.
        source: what an error calls them.

    Raises:
        InputError: hardly one is usable.
    """
    collector = _Collector()
    collector.add(stamps_ns, values)
    return collector.recording(source)


class _Collector:
    """Takes samples block by block, drops bad ones, and averages neighbours once there are too many to keep."""

    def __init__(self) -> None:
        self._stamps: list[IntArray] = []
        self._values: list[FloatArray] = []
        self._last_ns: int | None = None
        self._kept = self._offered = self._good = 0
        self._rate_hz = 0.0

    def add(self, stamps_ns: IntArray, values: FloatArray) -> None:
        """Add samples (N,), (N, 6)."""
        newest = np.maximum.accumulate(stamps_ns)
        before = np.concatenate([[stamps_ns[0] - 1 if self._last_ns is None else self._last_ns], newest[:-1]])
        good = np.isfinite(values).all(axis=1) & (stamps_ns > before)
        stamps_ns, values = stamps_ns[good], values[good]
        self._last_ns = int(newest[-1]) if self._last_ns is None else max(int(newest[-1]), self._last_ns)
        self._offered += len(good)
        self._good += len(stamps_ns)
        if not self._rate_hz and len(stamps_ns) > 1:
            self._rate_hz = NANOSECONDS / float(np.median(np.diff(stamps_ns)))
        self._stamps.append(stamps_ns)
        self._values.append(values)
        self._kept += len(stamps_ns)
        if self._kept > _MOST_SAMPLES:
            stamps_ns, values = _halved(*self._joined())
            self._stamps, self._values, self._kept = [stamps_ns], [values], len(stamps_ns)

    def recording(self, source: str) -> ImuRecording:
        """Return what was collected.

        Raises:
            InputError: hardly one sample is usable.
        """
        if self._good < _FEWEST:
            raise InputError(
                f"{source} holds '{self._good}' usable samples of {self._offered}, expected finite values with rising stamps; "
                "check the IMU's driver and record again"
            )
        return ImuRecording(*self._joined(), self._rate_hz, self._offered - self._good)

    def _joined(self) -> tuple[IntArray, FloatArray]:
        return np.concatenate(self._stamps), np.concatenate(self._values)


def _halved(stamps_ns: IntArray, values: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the averages of neighbours."""
    even = len(stamps_ns) // 2 * 2
    first, second = stamps_ns[:even:2], stamps_ns[1:even:2]
    return first + (second - first) // 2, 0.5 * (values[:even:2] + values[1:even:2])
