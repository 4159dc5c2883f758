"""Nodes that run and yet do nothing: one that hangs, and one that the messages of another no longer reach.

A process that is killed may leave shared memory in a state that others wait for, or write to in vain. A node that is started
again has memory of its own, so that is what helps: the graph heals as after a crash.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from vli_bringup.listener import count_of
from vli_common.status import NodeState, StageStatus

_SILENT_S = 20.0
"""Nodes say once a second how they are."""
_DEAF_S, _DEAF_MESSAGES = 6.0, 30
"""So many messages of another node that have not come, in so long, are not under way."""
_AT_WORK = (NodeState.READY, NodeState.FINISHED)


class Ender(Protocol):
    """What can end a node."""

    def end(self, node: str, reason: str) -> None:
        """End a node that is not as it should be; who looks after crashes starts it again."""


@dataclass(frozen=True, slots=True)
class _Mark:
    """What a reader had received, and its source sent, at a time (monotonic seconds), and the session."""

    session: str
    received: int
    sent: int
    at_s: float


class GraphWatch:
    """Ends nodes that say nothing, or hear nothing of what is sent to them.

    Where a reader that was started again still hears nothing, its source is ended.

    Args:
        processes: of the nodes.
    """

    def __init__(self, processes: Ender) -> None:
        self._processes = processes
        self._marks: dict[tuple[str, str], _Mark] = {}
        self._blamed: set[tuple[str, str]] = set()
        self._patient_until_s: dict[str, float] = {}

    def look(self, statuses: Mapping[str, StageStatus], heard_s: Mapping[str, float]) -> None:
        """Look after the nodes.

        Args:
            statuses: the newest of each node.
            heard_s: when that came, monotonic seconds.
        """
        now_s = time.monotonic()
        for node, last_s in heard_s.items():
            if now_s - max(last_s, self._patient_until_s.get(node, 0.0)) > _SILENT_S:
                self._end(node, f"has said nothing for {now_s - last_s:.0f} s", now_s)
        sources = {
            key.removeprefix("sent."): node
            for node, status in statuses.items()
            for key in status.values
            if key.startswith("sent.") and status.state in _AT_WORK
        }
        for node, status in statuses.items():
            for key, value in status.values.items():
                topic = key.removeprefix("received.")
                if topic != key and topic in sources and status.state in _AT_WORK:
                    self._compare(node, topic, count_of(value), sources[topic], statuses, now_s)

    def _compare(
        self, node: str, topic: str, received: int, source: str, statuses: Mapping[str, StageStatus], now_s: float
    ) -> None:
        session = statuses[node].values.get("session", "")
        sent = count_of(statuses[source].values[f"sent.{topic}"])
        mark = self._marks.get((node, topic))
        if mark is None or (mark.session, mark.received) != (session, received) or sent < mark.sent:
            self._marks[node, topic] = _Mark(session, received, sent, now_s)
            if mark is not None and received > mark.received:
                self._blamed.discard((node, topic))
            return
        if session != statuses[source].values.get("session") or now_s - mark.at_s < _DEAF_S or sent - mark.sent < _DEAF_MESSAGES:
            return
        guilty = source if (node, topic) in self._blamed else node
        self._blamed ^= {(node, topic)}
        del self._marks[node, topic]
        self._end(guilty, f"is cut off: '{node}' has heard nothing of {sent - mark.sent} messages on '{topic}'", now_s)

    def _end(self, node: str, reason: str, now_s: float) -> None:
        self._patient_until_s[node] = now_s
        self._marks = {key: mark for key, mark in self._marks.items() if key[0] != node}
        self._processes.end(node, reason)
