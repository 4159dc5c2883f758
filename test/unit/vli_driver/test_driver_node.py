"""The driver as a node: its playback ends when it is told to, and never silently."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy
from patience import wait

from vli_common.messages import status_to_message
from vli_common.status import Health, NodeState, StageStatus
from vli_driver.nodes.driver_node import DriverNode


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch, repository: Path) -> Iterator[DriverNode]:
    """Return a driver that waits for a node which never comes."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    values = (f"bag:={repository / 'bags' / 'demo' / 'bag'}", "wait_for:=nobody", "loop:=true")
    rclpy.init(args=["--ros-args", *(item for value in values for item in ("-p", value))])
    item = DriverNode()
    yield item
    item.close()
    item.destroy_node()
    rclpy.try_shutdown()


def test_a_driver_that_waits_for_others_stops_when_it_is_told_to(node: DriverNode) -> None:
    node.start()
    wait(lambda: node._thread)
    thread = node._thread
    assert thread is not None
    assert thread.is_alive()
    assert node.close()
    assert not thread.is_alive()
    assert node.failure is None


def test_a_cleaned_up_driver_has_no_playback_left_beside_the_next_one(node: DriverNode) -> None:
    node.start()
    wait(lambda: node._thread)
    first = node._thread
    node.trigger_deactivate()
    node.trigger_cleanup()
    assert first is not None
    assert not first.is_alive()
    node.trigger_configure()
    node.trigger_activate()
    wait(lambda: node._thread)
    assert node._thread is not first


def test_a_driver_started_again_begins_a_session_that_the_graph_has_not_had(node: DriverNode) -> None:
    node.start()
    wait(lambda: node._thread)
    assert node.newest_session == 0
    status = StageStatus(time.time_ns(), "nobody", Health.OK, NodeState.FINISHED, "", {"session": "1", "unmatched": ""})
    node._on_status(status_to_message(status))
    wait(lambda: node.newest_session == 2)


def test_a_playback_that_fails_ends_the_node_and_does_not_leave_it_idle(
    node: DriverNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> None:
        raise RuntimeError("damaged in a way nobody thought of")

    monkeypatch.setattr(node, "_open_reader", fail)
    monkeypatch.setattr(node, "check", lambda: None)
    node.start()
    wait(lambda: node.failure)
    assert node.failure == "RuntimeError: damaged in a way nobody thought of"
