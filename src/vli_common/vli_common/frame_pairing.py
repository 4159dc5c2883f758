"""What the back end needs comes on three topics; here it is put in the order of its stamps again.

Tracks and preintegration of one long frame are paired by stamp, and a scan goes before the first frame that is younger than
it, as it does offline: however late the front end is, no scan reaches the back end ahead of its frame.
"""

from __future__ import annotations

import bisect
from collections import deque
from dataclasses import dataclass
from typing import TypeAlias

from vli_common.clock import AHEAD_NS
from vli_common.types import Counters, FrontEndOutput, LaserScan, Preintegration, Tracks

_MAX_FRAMES = 60
_MAX_SCANS = 600


@dataclass(frozen=True, slots=True)
class NoPreintegration:
    """Says that the frame of this stamp has no preintegration: the first of a session, or a mode without IMU."""

    stamp_ns: int
    session: int = 0


Item: TypeAlias = LaserScan | FrontEndOutput


def _stamp(item: LaserScan | Preintegration | NoPreintegration) -> int:
    return item.stamp_ns


class FramePairing:
    """Joins :class:`Tracks`, :class:`Preintegration` and :class:`LaserScan`, in order of their stamps.

    A frame that is not younger than the last one, or too much so for one session, is dropped: no front end sends it.

    Counters: ``tracks_out_of_order``, ``tracks_without_preintegration`` (a newer one came, or too many frames wait: the frame
    goes on without), ``preintegration_without_tracks``, ``scans_late`` (older than a frame that has gone: they go at once),
    ``scans_without_frame`` (too many wait: the oldest are dropped).
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self.clear()

    def clear(self) -> None:
        """Forget what waits: a new session begins."""
        self._tracks: deque[Tracks] = deque()
        self._inertial: deque[Preintegration | NoPreintegration] = deque()
        self._scans: deque[LaserScan] = deque()
        self._newest_ns = -1

    def add_tracks(self, tracks: Tracks) -> list[Item]:
        """Take the tracks of one frame; return what can go now, in order."""
        newest_ns = self._tracks[-1].stamp_ns if self._tracks else self._newest_ns
        if newest_ns >= 0 and not 0 < tracks.stamp_ns - newest_ns <= AHEAD_NS:
            self.counters.add("tracks_out_of_order")
            return []
        self._tracks.append(tracks)
        return self._release()

    def add_preintegration(self, preintegration: Preintegration | NoPreintegration) -> list[Item]:
        """Take the preintegration of one frame; return what can go now, in order."""
        bisect.insort(self._inertial, preintegration, key=_stamp)
        if len(self._inertial) > _MAX_FRAMES:
            self._inertial.popleft()
            self.counters.add("preintegration_without_tracks")
        return self._release()

    def add_scan(self, scan: LaserScan) -> list[Item]:
        """Take the stripe of a short frame; return what can go now, in order."""
        if scan.stamp_ns < self._newest_ns:
            self.counters.add("scans_late")
            return [scan]
        bisect.insort(self._scans, scan, key=_stamp)
        if len(self._scans) > _MAX_SCANS:
            self._scans.popleft()
            self.counters.add("scans_without_frame")
        return []

    def flush(self) -> list[Item]:
        """Return the scans that wait for a frame, at the end of the input."""
        scans = list(self._scans)
        self._scans.clear()
        return [*scans]

    def _release(self) -> list[Item]:
        items: list[Item] = []
        while self._tracks and (self._is_answered(self._tracks[0].stamp_ns) or len(self._tracks) > _MAX_FRAMES):
            tracks = self._tracks.popleft()
            self._newest_ns = tracks.stamp_ns
            while self._scans and self._scans[0].stamp_ns < tracks.stamp_ns:
                items.append(self._scans.popleft())
            items.append(FrontEndOutput(tracks, self._take_inertial(tracks.stamp_ns)))
        return items

    def _is_answered(self, stamp_ns: int) -> bool:
        """Return True where the preintegration of a stamp, or of a later one, is there."""
        while self._inertial and self._inertial[0].stamp_ns < stamp_ns:
            self._inertial.popleft()
            self.counters.add("preintegration_without_tracks")
        return bool(self._inertial)

    def _take_inertial(self, stamp_ns: int) -> Preintegration | None:
        if self._inertial and self._inertial[0].stamp_ns == stamp_ns:
            measured = self._inertial.popleft()
            return measured if isinstance(measured, Preintegration) else None
        self.counters.add("tracks_without_preintegration")
        return None
