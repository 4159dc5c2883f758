"""Nodes that run and yet do nothing: one that hangs, and one that the messages of another no longer reach.

A process that is killed may leave shared memory in a state that others wait for, or write to in vain. A node that is started
again has memory of its own, so that is what helps: the graph heals as after a crash.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping
from typing import Protocol

from vli_bringup.losses import count_of
from vli_common.reception import Reception
from vli_common.status import NodeState, StageStatus

_SILENT_S = 20.0
"""Nodes say once a second how they are."""
_AT_WORK = (NodeState.READY, NodeState.FINISHED)


class Ender(Protocol):
    """What can end a node."""

    def end(self, node: str, reason: str) -> None:
        """End a node that is not as it should be; who looks after crashes starts it again."""


class GraphWatch:
    """Ends nodes that say nothing, or hear nothing of what is sent to them.

    Where a reader that was started again still hears nothing, its source is ended.

    Args:
        processes: of the nodes.
    """

    def __init__(self, processes: Ender) -> None:
        self._processes = processes
        self._receptions: dict[tuple[str, str], Reception] = defaultdict(Reception)
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
        reception = self._receptions[node, topic]
        before = reception.received
        missed = reception.missed(session, received, sent, now_s)
        if before is not None and received > before:
            self._blamed.discard((node, topic))
        if not missed or session != statuses[source].values.get("session"):
            return
        guilty = source if (node, topic) in self._blamed else node
        self._blamed ^= {(node, topic)}
        del self._receptions[node, topic]
        self._end(guilty, f"is cut off: '{node}' has heard nothing of {missed} messages on '{topic}'", now_s)

    def _end(self, node: str, reason: str, now_s: float) -> None:
        self._patient_until_s[node] = now_s
        for key in [key for key in self._receptions if key[0] == node]:
            del self._receptions[key]
        self._processes.end(node, reason)
