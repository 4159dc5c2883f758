"""Brings long frames and IMU samples together: a frame goes on once the IMU covers its stamp, ``t_imu = t_cam + timeshift``."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum

import numpy as np

from vli_common.arrays import FloatArray, IntArray
from vli_common.types import NANOSECONDS, Counters, ImuSample
from vli_frontend.imu_gaps import HOLE, period_ns
from vli_frontend.photometry import Frame

_CAPACITY = 8192
_MAX_WAITING = 32
_RECENT = 32
"""Samples that tell the period."""
_LATEST_NS = NANOSECONDS // 10
"""How far behind the newest sample one may come and still be used."""


@dataclass(frozen=True, slots=True)
class ImuSegment:
    """The IMU between two instants, whose own values are interpolated.

    Args:
        stamps: (M,) int64, IMU clock, first and last are the ends asked for; M ≥ 2.
        gyro: (M, 3) rad/s.
        accel: (M, 3) m/s².
        gaps_ns: (M − 1,) int64, of the samples around each step: longer than the step at the two ends.
    """

    stamps: IntArray
    gyro: FloatArray
    accel: FloatArray
    gaps_ns: IntArray

    @property
    def longest_gap_ns(self) -> int:
        """Longest interval between consecutive samples that the segment rests on."""
        return int(self.gaps_ns.max())

    @property
    def mean_rate(self) -> FloatArray:
        """Mean angular rate (3,) rad/s, by the trapezoidal rule."""
        dt = np.diff(self.stamps) * 1e-9
        result: FloatArray = (0.5 * (self.gyro[1:] + self.gyro[:-1]) * dt[:, None]).sum(axis=0) / dt.sum()
        return result


class ImuHistory:
    """The newest IMU samples, strictly ascending in time; at most ``_CAPACITY`` (40 s at 200 Hz)."""

    def __init__(self) -> None:
        self._stamps = np.empty(2 * _CAPACITY, np.int64)
        self._values = np.empty((2 * _CAPACITY, 6))
        self._count = 0

    @property
    def newest_ns(self) -> int | None:
        """Newest stamp, IMU clock."""
        return int(self._stamps[self._count - 1]) if self._count else None

    @property
    def oldest_ns(self) -> int:
        """Oldest stamp, IMU clock; there must be samples."""
        return int(self._stamps[0])

    def first_from(self, stamp_ns: int) -> int | None:
        """Return the first stamp at or after ``stamp_ns``."""
        index = int(np.searchsorted(self._stamps[: self._count], stamp_ns, side="left"))
        return int(self._stamps[index]) if index < self._count else None

    def append(self, sample: ImuSample) -> None:
        """Add a sample newer than all others."""
        self._make_room()
        self._put(self._count, sample)

    def insert(self, sample: ImuSample) -> bool:
        """Put a sample that comes late where it belongs, after the oldest; False where its stamp is there already."""
        self._make_room()
        at = int(np.searchsorted(self._stamps[: self._count], sample.stamp_ns))
        if self._stamps[at] == sample.stamp_ns:
            return False
        behind, moved = slice(at, self._count), slice(at + 1, self._count + 1)
        self._stamps[moved], self._values[moved] = self._stamps[behind].copy(), self._values[behind].copy()
        self._put(at, sample)
        return True

    def _make_room(self) -> None:
        if self._count == len(self._stamps):
            self._stamps[:_CAPACITY], self._values[:_CAPACITY] = self._stamps[_CAPACITY:], self._values[_CAPACITY:]
            self._count = _CAPACITY

    def _put(self, at: int, sample: ImuSample) -> None:
        self._stamps[at] = sample.stamp_ns
        self._values[at, :3], self._values[at, 3:] = sample.gyro, sample.accel
        self._count += 1

    def has_hole_at_end(self, stamp_ns: int) -> bool:
        """Return whether only the newest sample lies at or after a stamp, and one before it may still be on its way."""
        recent = self._stamps[max(0, self._count - _RECENT) : self._count]
        if len(recent) < _RECENT or recent[-2] >= stamp_ns:
            return False
        return bool(recent[-1] - recent[-2] > HOLE * period_ns(recent))

    def clear(self) -> None:
        """Forget all samples."""
        self._count = 0

    def segment(self, begin_ns: int, end_ns: int) -> ImuSegment | None:
        """Return the IMU from ``begin_ns`` to ``end_ns`` (IMU clock), or None where the samples do not reach around both."""
        stamps = self._stamps[: self._count]
        first = int(np.searchsorted(stamps, begin_ns, side="right")) - 1
        last = int(np.searchsorted(stamps, end_ns, side="left"))
        if end_ns <= begin_ns or first < 0 or last >= self._count:
            return None
        inside = slice(first + 1, last)
        ends = np.stack([self._at(first, begin_ns), self._at(last - 1, end_ns)])
        values = np.concatenate([ends[:1], self._values[inside], ends[1:]])
        gaps = np.diff(stamps[first : last + 1])
        return ImuSegment(np.concatenate([[begin_ns], stamps[inside], [end_ns]]), values[:, :3], values[:, 3:], gaps)

    def newest(self, count: int, until_ns: int) -> tuple[IntArray, FloatArray]:
        """Return stamps (M,) and values (M, 6), gyroscope and accelerometer, of the last ``count`` samples up to a stamp."""
        end = int(np.searchsorted(self._stamps[: self._count], until_ns, side="right"))
        chosen = slice(max(0, end - count), end)
        return self._stamps[chosen], self._values[chosen]

    def _at(self, index: int, stamp_ns: int) -> FloatArray:
        """Return the values at a stamp between samples ``index`` and ``index + 1``."""
        before, after = int(self._stamps[index]), int(self._stamps[index + 1])
        alpha = (stamp_ns - before) / (after - before)
        result: FloatArray = (1.0 - alpha) * self._values[index] + alpha * self._values[index + 1]
        return result


class Waiting(Enum):
    """Why no frame goes on."""

    NO_FRAME = "no long frame waits"
    NO_IMU = "no IMU sample has come yet"
    IMU_BEHIND = "the IMU does not reach the frame yet"


@dataclass(frozen=True, slots=True)
class ReadyFrame:
    """A long frame that may go on; ``covered`` tells whether the IMU reaches its stamp."""

    frame: Frame
    covered: bool


class Synchroniser:
    """Holds long frames until the IMU covers them; keeps both in strict order.

    An IMU sample that comes late is put where it belongs, and where one seems to be missing just before a frame, the next is
    awaited. Frames out of order, and what is duplicated, too late or not finite, are dropped and counted.

    A frame waits at most ``max_wait_ns`` of data time (of IMU or of later frames): then it goes on without the IMU, so that a
    dead IMU does not stop the camera, and no result depends on what comes later.

    Args:
        timeshift_ns: ``t_imu = t_cam + timeshift``.
        max_wait_ns: see above.
        uses_imu: False releases each frame at once.
        counters: of the stage.
    """

    def __init__(self, timeshift_ns: int, max_wait_ns: int, uses_imu: bool, counters: Counters) -> None:
        self.imu = ImuHistory()
        self.timeshift_ns = timeshift_ns
        """May be changed at any time; holds for what is asked from then on."""
        self._max_wait_ns, self._uses_imu = max_wait_ns, uses_imu
        self._counters = counters
        self._waiting: deque[Frame] = deque()
        self._newest_frame_ns: int | None = None

    def clear(self) -> None:
        """Forget everything: a new session begins."""
        self.imu.clear()
        self._waiting.clear()
        self._newest_frame_ns = None

    def add_imu(self, sample: ImuSample) -> bool:
        """Take a sample; False where it was dropped."""
        if not (np.isfinite(sample.gyro).all() and np.isfinite(sample.accel).all()):
            return self._drop("imu_not_finite")
        newest = self.imu.newest_ns
        if newest is None or sample.stamp_ns > newest:
            self.imu.append(sample)
            return True
        if sample.stamp_ns < max(newest - _LATEST_NS, self.imu.oldest_ns):
            return self._drop("imu_too_late")
        if not self.imu.insert(sample):
            return self._drop("imu_duplicate")
        self._counters.add("imu_out_of_order")
        return True

    def add_frame(self, frame: Frame) -> bool:
        """Take a long frame; False where it was dropped."""
        newest = self._newest_frame_ns
        if newest is not None and frame.stamp_ns <= newest:
            return self._drop("frames_duplicate" if frame.stamp_ns == newest else "frames_out_of_order")
        self._newest_frame_ns = frame.stamp_ns
        self._waiting.append(frame)
        if len(self._waiting) > _MAX_WAITING:
            self._waiting.popleft()
            self._counters.add("frames_overrun")
        return True

    def next(self) -> ReadyFrame | Waiting:
        """Return the oldest frame once it may go on, or why it may not."""
        if not self._waiting:
            return Waiting.NO_FRAME
        if not self._uses_imu:
            return ReadyFrame(self._waiting.popleft(), covered=False)
        stamp_ns = self.to_imu_clock(self._waiting[0].stamp_ns)
        deadline_ns = stamp_ns + self._max_wait_ns
        next_ns = self.imu.first_from(stamp_ns)
        if next_ns is not None and next_ns <= deadline_ns:
            if self.imu.has_hole_at_end(stamp_ns) and self.to_imu_clock(self._waiting[-1].stamp_ns) <= deadline_ns:
                return Waiting.IMU_BEHIND
            return ReadyFrame(self._waiting.popleft(), covered=True)
        if next_ns is not None or self.to_imu_clock(self._waiting[-1].stamp_ns) > deadline_ns:
            self._counters.add("frames_without_imu")
            return ReadyFrame(self._waiting.popleft(), covered=False)
        return Waiting.NO_IMU if self.imu.newest_ns is None else Waiting.IMU_BEHIND

    def to_imu_clock(self, stamp_ns: int) -> int:
        """Return a camera stamp on the clock of the IMU."""
        return stamp_ns + self.timeshift_ns

    def segment(self, begin_ns: int, end_ns: int) -> ImuSegment | None:
        """Return the IMU between two camera stamps, or None where it does not cover them."""
        return self.imu.segment(self.to_imu_clock(begin_ns), self.to_imu_clock(end_ns))

    def _drop(self, counter: str) -> bool:
        self._counters.add(counter)
        return False


def seconds_to_ns(seconds: float) -> int:
    """Return whole nanoseconds."""
    return round(seconds * NANOSECONDS)
