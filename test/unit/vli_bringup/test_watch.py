"""Nodes that run and yet do nothing are ended, others are left alone."""

from __future__ import annotations

import pytest

from vli_bringup import watch
from vli_bringup.watch import GraphWatch
from vli_common.status import Health, NodeState, StageStatus

IMAGE = "/camera/image_raw"


class Graph:
    """Says what its nodes say, once a second; ``ended`` are the nodes that the watch has ended, and why."""

    def __init__(self, monkeypatch):
        self.now_s, self.ended = 1000.0, []
        self.values = {"driver_node": {f"sent.{IMAGE}": 0}, "demux_node": {f"received.{IMAGE}": 0}}
        self.states = dict.fromkeys(self.values, NodeState.READY)
        self.sessions = dict.fromkeys(self.values, "1")
        self.silent = set()
        self.watch, self._heard_s = GraphWatch(self), dict.fromkeys(self.values, self.now_s)
        monkeypatch.setattr(watch.time, "monotonic", lambda: self.now_s)

    def end(self, node, reason):
        self.ended.append((node, reason))

    def run(self, seconds, sent=60, received=60):
        for _ in range(seconds):
            self.now_s += 1.0
            self.values["driver_node"][f"sent.{IMAGE}"] += sent
            self.values["demux_node"][f"received.{IMAGE}"] += received
            self._heard_s.update((node, self.now_s) for node in self.values if node not in self.silent)
            self.watch.look({node: self._status(node) for node in self.values}, self._heard_s)
        return [node for node, _ in self.ended]

    def _status(self, node):
        values = {"session": self.sessions[node], **{key: str(value) for key, value in self.values[node].items()}}
        return StageStatus(0, node, Health.OK, self.states[node], "", values)


@pytest.fixture
def graph(monkeypatch):
    return Graph(monkeypatch)


def test_nodes_that_hear_each_other_are_left_alone(graph):
    assert graph.run(100) == []


def test_a_node_that_says_nothing_is_ended_and_has_time_to_come_back(graph):
    graph.silent.add("demux_node")
    assert graph.run(15) == []
    assert graph.run(10) == ["demux_node"]
    assert graph.ended == [("demux_node", "has said nothing for 21 s")]
    graph.silent.clear()
    assert graph.run(60) == ["demux_node"]


def test_a_node_that_hears_nothing_of_what_is_sent_is_ended(graph):
    graph.run(5)
    graph.run(10, received=0)
    assert graph.ended == [("demux_node", f"is cut off: 'demux_node' has heard nothing of 360 messages on '{IMAGE}'")]
    assert graph.run(30) == ["demux_node"]


def test_where_that_does_not_help_its_source_is_ended(graph):
    assert graph.run(18, received=0) == ["demux_node", "driver_node"]


@pytest.mark.parametrize("sent", [0, 1])
def test_a_source_that_sends_little_cuts_nobody_off(graph, sent):
    assert graph.run(25, sent=sent, received=0) == []


def test_who_is_paused_or_of_another_session_is_not_judged(graph):
    graph.states["demux_node"] = NodeState.PAUSED
    assert graph.run(20, received=0) == []
    graph.states["demux_node"], graph.sessions["driver_node"] = NodeState.READY, "2"
    assert graph.run(20, received=0) == []


def test_a_camera_outside_the_graph_is_not_judged(graph):
    del graph.values["driver_node"][f"sent.{IMAGE}"]
    graph.values["driver_node"]["sent.status"] = 0
    graph.now_s += 1.0
    for _ in range(20):
        graph.now_s += 1.0
        graph.watch.look({node: graph._status(node) for node in graph.values}, {})
    assert graph.ended == []


def test_nonsense_in_a_status_does_not_end_the_command(graph):
    graph.values["driver_node"] = {f"sent.{IMAGE}": 0}
    status = StageStatus(0, "driver_node", Health.OK, NodeState.READY, "", {f"sent.{IMAGE}": "many"})
    graph.watch.look({"driver_node": status, "demux_node": graph._status("demux_node")}, {})
    assert graph.ended == []
