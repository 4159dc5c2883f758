"""Whether what one node sends reaches another, by what both count."""

from __future__ import annotations

from dataclasses import dataclass

_SECONDS, _MESSAGES = 6.0, 30
"""So many messages that have not come, in so long, are not under way."""


@dataclass(frozen=True, slots=True)
class _Mark:
    """What had come, and had been sent, when it was last certain that something gets through (monotonic seconds)."""

    session: str
    received: int
    sent: int
    at_s: float


class Reception:
    """What comes of one topic."""

    def __init__(self) -> None:
        self._mark: _Mark | None = None

    @property
    def received(self) -> int | None:
        """Messages that had come when :meth:`missed` was last asked; None before."""
        return self._mark.received if self._mark else None

    def missed(self, session: str, received: int, sent: int, now_s: float) -> int:
        """Return how many messages were sent in vain since one last came; 0 where they may still be under way.

        Args:
            session: of the receiver; it counts anew in each.
            received, sent: by both so far.
            now_s: monotonic seconds.
        """
        mark = self._mark
        if mark is None or (mark.session, mark.received) != (session, received) or sent < mark.sent:
            self._mark = _Mark(session, received, sent, now_s)
            return 0
        in_vain = sent - mark.sent
        return in_vain if now_s - mark.at_s >= _SECONDS and in_vain >= _MESSAGES else 0
