"""Jumps of the sensor clock, which begin a new session: a bag that loops, a clock that is set, a camera that restarts."""

from __future__ import annotations

from dataclasses import dataclass

from vli_common.types import NANOSECONDS

_BACK_NS = NANOSECONDS
AHEAD_NS = 10 * NANOSECONDS
"""Within a session, no two frames in a row are farther apart."""


@dataclass(frozen=True, slots=True)
class ClockJump:
    """A step of the clock that begins a new session.

    Args:
        reason: in words.
        is_repeat: True where the stream begins again where it began: a bag that is played in a loop, and no fault.
    """

    reason: str
    is_repeat: bool

    @property
    def counter(self) -> str:
        """Name of what it is counted as."""
        return "played_again" if self.is_repeat else "clock_jump"


class ClockMonitor:
    """Tells a jump of the clock from frames that are late, lost or out of order; each stream is compared with itself."""

    def __init__(self) -> None:
        self._newest_ns: dict[str, int] = {}
        self._first_ns: dict[str, int] = {}

    def jump(self, stream: str, stamp_ns: int) -> ClockJump | None:
        """Take the stamp of the newest item of a stream; return what happened where it means a new session."""
        newest_ns = self._newest_ns.get(stream, stamp_ns)
        first_ns = self._first_ns.setdefault(stream, stamp_ns)
        step_ns = stamp_ns - newest_ns
        if -_BACK_NS <= step_ns <= AHEAD_NS:
            self._newest_ns[stream] = max(newest_ns, stamp_ns)
            return None
        # The other streams follow; their jump is the same one.
        self._newest_ns, self._first_ns = {stream: stamp_ns}, {stream: stamp_ns}
        by = f"{step_ns / NANOSECONDS:+.1f} s"
        if step_ns < 0 and abs(stamp_ns - first_ns) <= _BACK_NS:
            return ClockJump(f"the {stream} began again where it had begun, {by}: a bag in a loop", True)
        return ClockJump(f"the clock of the {stream} jumped by {by}", False)
