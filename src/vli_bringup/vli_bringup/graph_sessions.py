"""The sessions of a graph while it runs: a clock that jumps, a back end that is started anew or a reset begins one.

Poses of two sessions share no frame, so that each session has a recorder, and in the results a directory, of its own: the last
one is the run's own, those before it are ``session-1``, ``session-2`` …, as of ``vli run``.
"""

from __future__ import annotations

from bisect import bisect
from pathlib import Path

from vli_bringup.recorder import Recorder
from vli_common.calibration import Calibration


class GraphSessions:
    """A recorder for each session that the back end has been in.

    Args:
        calibration: see :class:`Recorder`.
    """

    def __init__(self, calibration: Calibration) -> None:
        self._calibration = calibration
        self._recorders: dict[int, Recorder] = {}
        self._began_ns: list[int] = []
        self._order: list[int] = []

    @property
    def number(self) -> int:
        """Of the present session."""
        return self._order[-1] if self._order else 0

    @property
    def recorder(self) -> Recorder:
        """Of the present session; its states are those of all."""
        return self._of(self.number)

    @property
    def poses(self) -> int:
        """Number of live poses in all sessions."""
        return sum(len(recorder.live) for recorder in self._recorders.values())

    @property
    def keyframes(self) -> int:
        """Number of keyframes in all sessions."""
        return sum(recorder.keyframes for recorder in self._recorders.values())

    def begin(self, session: int, published_ns: int) -> None:
        """The back end is in this session since it said so at ``published_ns``; that may be told again and again."""
        if not self._order or session != self._order[-1]:
            self._order.append(session)
            self._began_ns.append(published_ns)

    def at(self, published_ns: int) -> Recorder:
        """Return the recorder of what the back end published then: topics overtake each other, one publisher's clock does not."""
        if not self._order:
            return self.recorder
        return self._of(self._order[max(bisect(self._began_ns, published_ns) - 1, 0)])

    def of_window(self, session: int, published_ns: int) -> Recorder:
        """Return the recorder of a window, which says of what session it is; of an unknown one, see :meth:`at`."""
        return self._of(session) if session in self._order else self.at(published_ns)

    def write(self, directory: Path) -> dict[int, Path]:
        """Write trajectories; return session → directory of the earlier ones in which something was tracked."""
        last = self.recorder
        last.write(directory)
        tracked = {number: item for number, item in self._recorders.items() if item.live and item is not last}
        kept = {number: directory / f"session-{place}" for place, number in enumerate(tracked, 1)}
        for number, path in kept.items():
            path.mkdir()
            tracked[number].write(path)
        return kept

    def _of(self, session: int) -> Recorder:
        if session not in self._recorders:
            recorder = Recorder(self._calibration)
            for before in self._recorders.values():
                recorder.states, recorder.reason = before.states, before.reason
            self._recorders[session] = recorder
        return self._recorders[session]
