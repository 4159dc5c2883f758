"""The nodes of the graph by what they say of themselves: who was started anew, who has finished, and who is there twice."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from enum import Enum, auto

from vli_common.status import NodeState, StageStatus

_MOST = 64
"""Nodes that are kept in mind; a name costs a sender nothing."""
_DIGITS = 20
"""A number of more digits is none of ours."""
_ALIVE_S = 3.0
"""Nodes say once a second how they are. What a killed one has said last may come after the first words of its successor."""


class News(Enum):
    """What a status brings."""

    FIRST = auto()
    """A node that was not known."""
    KNOWN = auto()
    """More of one that is."""
    RESTARTED = auto()
    """The node was started anew: what it knew is gone."""
    NAMESAKE = auto()
    """Another process of that name, which does not count."""
    TOO_MANY = auto()
    """A node more than can be kept in mind."""


class Neighbours:
    """The newest status of each node, this one too.

    Of two processes of one name the one that was started last counts, while it lives: where both are heard in turn, each would
    seem to be started anew every time.

    Args:
        name: of this node.
        started_ns: wall clock at which it was started.
        clock: monotonic seconds.
    """

    def __init__(self, name: str, started_ns: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.statuses: dict[str, StageStatus] = {}
        """Name → newest status."""
        self._name, self._started_ns, self._clock = name, started_ns, clock
        self._heard_s: dict[str, float] = {}
        self._twice_s: dict[str, float] = {}

    def take(self, status: StageStatus) -> News:
        """Keep a status, unless it is of a namesake, or of a node too many; return what it brings."""
        known, now_s = self.statuses.get(status.node), self._clock()
        begun_ns = whole_number(status, "started_ns")
        known_ns = self._started_ns if status.node == self._name else whole_number(known, "started_ns") if known else 0
        if begun_ns and self._is_namesake(status.node, begun_ns, known_ns, now_s):
            if status.stamp_ns > max(begun_ns, known_ns) + _ALIVE_S * 1e9:
                self._twice_s[status.node] = now_s
            return News.NAMESAKE
        if known is None and len(self.statuses) >= _MOST:
            return News.TOO_MANY
        self.statuses[status.node], self._heard_s[status.node] = status, now_s
        if known is None:
            return News.FIRST
        return News.RESTARTED if begun_ns and 0 < known_ns != begun_ns else News.KNOWN

    def finished(self, session: int) -> dict[str, Mapping[str, str]]:
        """Return the values of each node that has finished this session."""
        return {
            name: status.values
            for name, status in list(self.statuses.items())
            if status.state is NodeState.FINISHED and status.values.get("session") == str(session)
        }

    @property
    def hint(self) -> str:
        """That a node is there twice, in words; empty where none is."""
        since_s = self._clock() - _ALIVE_S
        twice = [f"'{name}'" for name, heard_s in self._twice_s.items() if heard_s > since_s]
        return f"{', '.join(twice)} runs twice: end one, or give each graph a namespace, or a ROS_DOMAIN_ID" if twice else ""

    def _is_namesake(self, name: str, begun_ns: int, known_ns: int, now_s: float) -> bool:
        if name == self._name:
            return begun_ns != known_ns
        return begun_ns < known_ns and now_s - self._heard_s[name] < _ALIVE_S


def whole_number(status: StageStatus, name: str) -> int:
    """Return a whole number out of a status; 0 where it does not say."""
    text = status.values.get(name, "")
    return int(text) if text.isdecimal() and len(text) < _DIGITS else 0
