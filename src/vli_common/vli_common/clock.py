"""Jumps of the sensor clock, which begin a new session: a bag that loops, a clock that is set, a camera that restarts."""

from __future__ import annotations

from vli_common.types import NANOSECONDS

_BACK_NS = NANOSECONDS
AHEAD_NS = 10 * NANOSECONDS
"""Within a session, no two frames in a row are farther apart."""


class ClockMonitor:
    """Tells a jump of the clock from frames that are late, lost or out of order; each stream is compared with itself."""

    def __init__(self) -> None:
        self._newest_ns: dict[str, int] = {}

    def jump(self, stream: str, stamp_ns: int) -> str | None:
        """Take the stamp of the newest item of a stream; return what happened where it means a new session, in words."""
        newest_ns = self._newest_ns.get(stream, stamp_ns)
        step_ns = stamp_ns - newest_ns
        if -_BACK_NS <= step_ns <= AHEAD_NS:
            self._newest_ns[stream] = max(newest_ns, stamp_ns)
            return None
        # The other streams follow; their jump is the same one.
        self._newest_ns = {stream: stamp_ns}
        return f"the clock of the {stream} jumped by {step_ns / NANOSECONDS:+.1f} s"
