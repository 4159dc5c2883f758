"""Tracks and preintegration of one long frame come on two topics; here they meet again by stamp."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from vli_common.types import Counters, FrontEndOutput, Preintegration, Tracks

_MAX_WAITING = 60


@dataclass(frozen=True, slots=True)
class NoPreintegration:
    """Says that the frame of this stamp has no preintegration: the first of a session, or a mode without IMU."""

    stamp_ns: int
    session: int = 0


class FramePairing:
    """Joins :class:`Tracks` and :class:`Preintegration` of equal stamps, in order of the tracks.

    Counters: ``tracks_without_preintegration`` (a newer one came, or too many frames wait: the frame goes on without),
    ``preintegration_without_tracks``.
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self._tracks: deque[Tracks] = deque()
        self._inertial: deque[Preintegration | NoPreintegration] = deque()

    def add_tracks(self, tracks: Tracks) -> list[FrontEndOutput]:
        """Take the tracks of one frame; return the frames that are complete now."""
        self._tracks.append(tracks)
        return self._pair()

    def add_preintegration(self, preintegration: Preintegration | NoPreintegration) -> list[FrontEndOutput]:
        """Take the preintegration of one frame; return the frames that are complete now."""
        self._inertial.append(preintegration)
        return self._pair()

    def clear(self) -> None:
        """Forget what waits: a new session begins."""
        self._tracks.clear()
        self._inertial.clear()

    def _pair(self) -> list[FrontEndOutput]:
        frames: list[FrontEndOutput] = []
        while self._tracks:
            stamp_ns = self._tracks[0].stamp_ns
            while self._inertial and self._inertial[0].stamp_ns < stamp_ns:
                self._inertial.popleft()
                self.counters.add("preintegration_without_tracks")
            if not self._inertial and len(self._tracks) <= _MAX_WAITING:
                break
            measured: Preintegration | NoPreintegration | None = None
            if self._inertial and self._inertial[0].stamp_ns == stamp_ns:
                measured = self._inertial.popleft()
            else:
                self.counters.add("tracks_without_preintegration")
            frames.append(FrontEndOutput(self._tracks.popleft(), measured if isinstance(measured, Preintegration) else None))
        return frames
