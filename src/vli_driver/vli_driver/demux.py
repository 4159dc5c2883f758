"""One interleaved stream into long and short exposures, by brightness and rhythm.

Brightness alone fails on a flash or a covered lens, rhythm alone on a missed trigger; together they correct each other. A
frame on which they disagree waits for its successor: if that one disagrees as well, the rhythm has slipped; if not, the frame
itself was odd. A frame is called short only where both agree, so that no long frame is ever read as a stripe.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vli_common.clock import ClockMonitor
from vli_common.types import NANOSECONDS, Counters, Exposure, Image
from vli_driver.brightness import brightness
from vli_driver.config import DemuxConfig
from vli_driver.rhythm import Rhythm

_LOCK_FRAMES = 4
_LATE_LOCK_FRAMES = 60
_MOST_WAITING = 600
"""Frames that wait for a verdict, however close their stamps are."""
_HYSTERESIS = 0.15
"""Share of the contrast, around the middle of the two levels, in which brightness says nothing."""

SortedFrames = list[tuple[Exposure, Image]]


@dataclass(frozen=True, slots=True)
class _Frame:
    """An image with its log brightness and its slot; ``in_rhythm``: the slot is reliable relative to the frame before."""

    image: Image
    level: float
    slot: int
    in_rhythm: bool


class BrightnessLevels:
    """The two levels (log brightness) that long and short frames have; they follow only while they differ.

    Args:
        contrast: least difference, log of a ratio.
        adaptation: share of the way to the newest pair, per frame.
    """

    def __init__(self, contrast: float, adaptation: float) -> None:
        self._contrast = contrast
        self._adaptation = adaptation
        self._level = {Exposure.LONG: math.nan, Exposure.SHORT: math.nan}
        self._newest = dict(self._level)

    @property
    def known(self) -> bool:
        """True once both levels were seen."""
        return not any(math.isnan(level) for level in self._level.values())

    def learn(self, slots: Sequence[int], levels: Sequence[float]) -> int | None:
        """Find the levels of an alternating sequence; return the parity of its long frames, None where it does not alternate."""
        parity, values = np.asarray(slots) % 2, np.asarray(levels)
        groups = values[parity == 0], values[parity == 1]
        if min(map(len, groups)) < _LOCK_FRAMES // 2:
            return None
        for long_parity in (0, 1):
            long, short = groups[long_parity], groups[1 - long_parity]
            if long.min() - short.max() >= self._contrast:
                self._level = {Exposure.LONG: float(np.median(long)), Exposure.SHORT: float(np.median(short))}
                self._newest = dict(self._level)
                return long_parity
        return None

    def classify(self, level: float) -> Exposure | None:
        """Return what a brightness looks like, None where it lies between the levels."""
        long, short = self._level[Exposure.LONG], self._level[Exposure.SHORT]
        offset = (level - 0.5 * (long + short)) / max(long - short, self._contrast)
        if not abs(offset) > _HYSTERESIS:
            return None
        return Exposure.LONG if offset > 0 else Exposure.SHORT

    def follow(self, exposure: Exposure, level: float) -> None:
        """Move towards the newest pair of levels; a flash or a covered lens, which leaves no contrast, moves nothing."""
        self._newest[exposure] = level
        if not self._newest[Exposure.LONG] - self._newest[Exposure.SHORT] >= self._contrast:
            return
        if not self.known:
            self._level = dict(self._newest)
        self._level[exposure] += self._adaptation * (level - self._level[exposure])


class Demultiplexer:
    """Sorts frames into :class:`Exposure` as they come; ``Image.laser_on``, where known, decides alone.

    Counters: ``long``, ``short``, ``missing`` (periods without a frame), ``duplicate``, ``out_of_order``, ``clock_jump``,
    ``played_again`` (a bag in a loop), ``phase_swap``, ``dark_long`` (a long frame as dark as a short one), ``ambient_light``
    (a short frame as bright as a long one: dropped), ``unclear`` (neither brightness nor rhythm tells: dropped).

    Args:
        config: see :class:`DemuxConfig`.
    """

    def __init__(self, config: DemuxConfig | None = None) -> None:
        self.config = config or DemuxConfig()
        self.counters = Counters()
        self.reset()

    def reset(self) -> None:
        """Forget everything but the counters: the next frame is the first of a stream, whatever its stamp."""
        self._clock = ClockMonitor()
        self._begin()

    def _begin(self) -> None:
        self.is_alternating: bool | None = None
        """True once long and short were told apart, False for a stream taken as all long, None while undecided."""
        self._last_ns: int | None = None
        self._rhythm = Rhythm(round(self.config.max_gap_s * NANOSECONDS))
        self._levels = BrightnessLevels(math.log(self.config.min_ratio), self.config.adaptation)
        self._long_parity = 0
        self._waiting: list[_Frame] = []
        self._watched: deque[_Frame] = deque(maxlen=_LATE_LOCK_FRAMES)
        self._held: _Frame | None = None

    def push(self, image: Image) -> SortedFrames:
        """Take the next image; return those that are decided by now, in order (none while the start is undecided)."""
        ready: SortedFrames = []
        if jump := self._clock.jump("camera", image.stamp_ns):
            self.counters.add(jump.counter)
            ready = self.flush()
            self._begin()
        elif self._last_ns is not None and image.stamp_ns <= self._last_ns:
            self.counters.add("duplicate" if image.stamp_ns == self._last_ns else "out_of_order")
            return []
        frame = self._measure(image)
        if image.laser_on is not None:
            return ready + self._sort_known(frame)
        if self.is_alternating:
            return ready + self._sort(frame)
        return ready + self._start(frame)

    def flush(self) -> SortedFrames:
        """Return what still waits, at the end of the input; a start that never alternated is all long."""
        ready = self._settle_held()
        ready += [self._accept(Exposure.LONG, frame) for frame in self._waiting]
        self._waiting = []
        return ready

    def _measure(self, image: Image) -> _Frame:
        count, in_rhythm = (1, False) if self._last_ns is None else self._rhythm.advance(image.stamp_ns - self._last_ns)
        self._last_ns = image.stamp_ns
        self.counters.add("missing", count - 1)
        return _Frame(image, math.log1p(brightness(image.pixels)), self._rhythm.slot, in_rhythm)

    def _start(self, frame: _Frame) -> SortedFrames:
        """Collect frames until they alternate; after ``start_s`` they are all long, unless they alternate for a second later."""
        if not frame.in_rhythm:
            self._watched.clear()
        self._watched.append(frame)
        enough = _LOCK_FRAMES if self.is_alternating is None else _LATE_LOCK_FRAMES
        if len(self._watched) >= enough:
            newest = list(self._watched)[-enough:]
            parity = self._levels.learn([item.slot for item in newest], [item.level for item in newest])
            if parity is not None:
                return self._lock(parity, frame)
        if self.is_alternating is False:
            return [self._accept(Exposure.LONG, frame)]
        self._waiting.append(frame)
        waited_ns = frame.image.stamp_ns - self._waiting[0].image.stamp_ns
        if waited_ns < self.config.start_s * NANOSECONDS and len(self._waiting) < _MOST_WAITING:
            return []
        self.is_alternating = False
        return self.flush()

    def _lock(self, parity: int, newest: _Frame) -> SortedFrames:
        self._long_parity = parity
        self.is_alternating = True
        frames, self._waiting = [*self._waiting, newest], []
        self._watched.clear()
        return [item for frame in frames for item in self._sort(frame)]

    def _sort_known(self, frame: _Frame) -> SortedFrames:
        """Believe the exposure topic; only a short frame as bright as a long one is dropped."""
        ready = self.flush()
        self.is_alternating = True
        exposure = Exposure.SHORT if frame.image.laser_on else Exposure.LONG
        self._align(exposure, frame)
        flash = exposure is Exposure.SHORT and self._levels.known and self._levels.classify(frame.level) is Exposure.LONG
        self._levels.follow(exposure, frame.level)
        return ready if self._dropped(flash, "ambient_light") else [*ready, self._accept(exposure, frame)]

    def _sort(self, frame: _Frame) -> SortedFrames:
        seen = self._levels.classify(frame.level)
        expected = self._expected(frame)
        slipped = self._held is not None and frame.in_rhythm and seen is not None and seen is not expected
        if slipped:
            self.counters.add("phase_swap")
            self._long_parity = 1 - self._long_parity
            expected = self._expected(frame)
        ready = self._settle_held()
        if not frame.in_rhythm and seen is not None:
            self._align(seen, frame)
            expected = seen
        self._levels.follow(expected, frame.level)
        if seen is expected:
            return [*ready, self._accept(expected, frame)]
        if seen is not None:
            self._held = frame
        elif frame.in_rhythm and expected is Exposure.LONG:
            ready.append(self._accept(expected, frame))
        else:
            self.counters.add("unclear")
        return ready

    def _settle_held(self) -> SortedFrames:
        """Decide the frame that waited: after a slip both agree on it; else the rhythm was right and the frame was odd."""
        frame, self._held = self._held, None
        if frame is None:
            return []
        expected, seen = self._expected(frame), self._levels.classify(frame.level)
        if expected is Exposure.SHORT and seen is not expected:
            self.counters.add("ambient_light")
            return []
        self.counters.add("dark_long", int(seen is not expected))
        return [self._accept(expected, frame)]

    def _expected(self, frame: _Frame) -> Exposure:
        return Exposure.LONG if frame.slot % 2 == self._long_parity else Exposure.SHORT

    def _align(self, exposure: Exposure, frame: _Frame) -> None:
        """Let the rhythm start anew at a frame that is known."""
        self._long_parity = (frame.slot + (exposure is Exposure.SHORT)) % 2

    def _dropped(self, condition: bool, counter: str) -> bool:
        self.counters.add(counter, int(condition))
        return condition

    def _accept(self, exposure: Exposure, frame: _Frame) -> tuple[Exposure, Image]:
        self.counters.add(exposure.value)
        return exposure, frame.image
