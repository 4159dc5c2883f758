"""How ``vli replay`` follows the graph."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import pytest

from vli_bringup import replay
from vli_bringup.graph import SCANNER
from vli_bringup.graph_run import MAPPING, RunningGraph
from vli_bringup.processes import GraphError
from vli_common.status import Health, NodeState, StageStatus


class Scripted(RunningGraph):
    """A graph whose driver stands still in a state until it is told to go on; then all have finished."""

    def __init__(self, state: NodeState, still_s: float) -> None:
        self.listener = SimpleNamespace(statuses={}, value=lambda *_: 1, state=lambda node: self.listener.statuses[node].state)
        self.stop, self.begin_s, self.data_s = threading.Event(), None, 0.0
        self._until_s = time.monotonic() + still_s
        self.say(state)

    def say(self, state: NodeState) -> None:
        for node in (SCANNER, MAPPING):
            self.listener.statuses[node] = StageStatus(0, node, Health.OK, state, "", {})

    def spin(self) -> None:
        time.sleep(0.01)
        if time.monotonic() > self._until_s:
            self.say(NodeState.FINISHED)


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay, "_SILENT_S", 0.2)


@pytest.mark.parametrize("state", [NodeState.PAUSED, NodeState.INACTIVE])
def test_a_graph_that_somebody_has_paused_may_stand_still(state: NodeState) -> None:
    graph = Scripted(state, still_s=0.6)
    replay._play(graph)
    assert graph.begin_s is not None


def test_one_that_stands_still_by_itself_has_failed() -> None:
    with pytest.raises(GraphError, match=r"the graph has not moved for 0\.2 s: driver_node ready, mapping_node ready"):
        replay._play(Scripted(NodeState.READY, still_s=5.0))
