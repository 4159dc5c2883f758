"""Alternates long exposures without and short exposures with the laser, and knows which is which.

A state machine without a clock or thread of its own: whoever owns the timer calls :meth:`Sequencer.tick`, whoever owns the camera
:meth:`Sequencer.on_image`. Both are given the time, so that a test can be the clock.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from vli_common.errors import ConfigError
from vli_common.types import NANOSECONDS, Counters, Exposure
from vli_driver.sources import LaserSwitch, TriggeredCamera

_PENDING = 8


@dataclass(frozen=True, slots=True)
class Shot:
    """One exposure as it was commanded; the stamp is mid-exposure."""

    stamp_ns: int
    exposure: Exposure
    exposure_s: float

    @property
    def laser_on(self) -> bool:
        """True for a short exposure."""
        return self.exposure is Exposure.SHORT

    @property
    def end_ns(self) -> int:
        """When the shutter closes."""
        return self.stamp_ns + round(0.5 * self.exposure_s * NANOSECONDS)


class Sequencer:
    """Triggers the camera ``rate_hz`` times a second, long and short in turn.

    The kind of a shot belongs to its slot, the count of periods since the start: a tick that comes too late or not at all
    leaves its slot empty, and what follows is what it would have been. The kind of an image is that of the shot that it matches
    in time, not that of the shot before: an image that is lost shifts nothing.

    Counters: ``triggered``, ``missed_slots``, ``lost_images``, ``unknown_images``.

    Args:
        camera: exposes.
        laser: is on in short exposures only.
        rate_hz: long and short together.
        exposure_long_s, exposure_short_s: seconds.

    Raises:
        ConfigError: the exposures do not fit into the period.
    """

    def __init__(
        self, camera: TriggeredCamera, laser: LaserSwitch, rate_hz: float, exposure_long_s: float, exposure_short_s: float
    ) -> None:
        self.counters = Counters()
        self._camera, self._laser = camera, laser
        self._period_ns = _period_ns(rate_hz, max(exposure_long_s, exposure_short_s))
        self._seconds = {Exposure.LONG: exposure_long_s, Exposure.SHORT: exposure_short_s}
        self._start_ns: int | None = None
        self._slot = -1
        self._shots: deque[Shot] = deque()

    def next_tick_ns(self, now_ns: int) -> int:
        """Return when :meth:`tick` should be called next."""
        if self._start_ns is None:
            return now_ns
        return self._start_ns + (self._slot + 1) * self._period_ns

    def tick(self, now_ns: int) -> Shot | None:
        """Begin the exposure of the slot that ``now_ns`` lies in; None where that was done already."""
        if self._start_ns is None:
            self._start_ns = now_ns
        slot = (now_ns - self._start_ns) // self._period_ns
        if slot <= self._slot:
            return None
        self.counters.add("missed_slots", slot - self._slot - 1)
        self._slot = slot
        return self._expose(Exposure.LONG if slot % 2 == 0 else Exposure.SHORT, now_ns)

    def on_image(self, closed_ns: int) -> Shot | None:
        """Return the shot of an image; None for an image that was not asked for.

        Args:
            closed_ns: when its shutter closed as far as the camera tells: its own stamp, or the arrival less the usual
                delay; right to
                half a period.
        """
        while self._shots and closed_ns > self._shots[0].end_ns + self._period_ns // 2:
            self._shots.popleft()
            self.counters.add("lost_images")
        if not self._shots or closed_ns < self._shots[0].end_ns - self._period_ns // 2:
            self.counters.add("unknown_images")
            return None
        return self._shots.popleft()

    def stop(self) -> None:
        """Turn the laser off; the next tick starts anew."""
        self._laser.set_laser(False)
        self._start_ns, self._slot = None, -1
        self._shots.clear()

    def _expose(self, exposure: Exposure, now_ns: int) -> Shot:
        seconds = self._seconds[exposure]
        shot = Shot(now_ns + round(0.5 * seconds * NANOSECONDS), exposure, seconds)
        self._laser.set_laser(shot.laser_on)
        self._camera.trigger(seconds)
        self.counters.add("triggered")
        self._shots.append(shot)
        if len(self._shots) > _PENDING:
            self._shots.popleft()
            self.counters.add("lost_images")
        return shot


def _period_ns(rate_hz: float, exposure_s: float) -> int:
    if not rate_hz > 0 or not 0 < exposure_s < 1 / rate_hz:
        raise ConfigError(
            [f"exposure of '{exposure_s}' s at '{rate_hz}' frames/s, expected more than 0 s and less than the period"]
        )
    return round(NANOSECONDS / rate_hz)
