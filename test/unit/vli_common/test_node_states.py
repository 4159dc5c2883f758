"""The states of a node, as services and lifecycle managers change them, also at a bad moment."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Iterator

import pytest
import rclpy
from patience import PATIENCE_S, wait
from rclpy.lifecycle import TransitionCallbackReturn

from vli_common.calibration import Calibration
from vli_common.errors import VliError
from vli_common.messages import status_to_message
from vli_common.node import VliNode, working
from vli_common.status import Health, NodeState, StageStatus
from vli_common.topics import DIAGNOSTICS, STATUS

DONE, REFUSED = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class Worked(VliNode):
    """Notes what is done to its stage; a job of its worker lasts until it is released."""

    def __init__(self) -> None:
        super().__init__("worked_node", {}, needs_calibration=False)
        self.done: list[str] = []
        self.released = threading.Event()

    def create_stage(self, calibration: Calibration | None) -> None:
        self.done.append("create")

    def drop_stage(self) -> None:
        self.done.append("drop")

    def on_pause(self) -> None:
        self.done.append("pause")

    def on_resume(self) -> None:
        self.done.append("resume")

    def be_busy(self) -> None:
        self.released.clear()
        self.enqueue(lambda: self.released.wait(PATIENCE_S) and None)


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Iterator[Worked]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setattr(working, "_CALL_S", 0.2)
    rclpy.init(args=["--ros-args", "-p", "autostart:=false", "-r", "__ns:=/left"])
    item = Worked()
    item.start()
    yield item
    item.released.set()
    assert item.close()
    item.destroy_node()
    rclpy.try_shutdown()


@pytest.fixture
def no_collection() -> Iterator[None]:
    gc.disable()
    yield
    gc.enable()


def bring_up(node: Worked) -> None:
    assert node.trigger_configure() is DONE
    assert node.trigger_activate() is DONE
    wait(lambda: node.state is NodeState.READY)


def test_a_node_that_is_deactivated_in_the_middle_of_its_work_ends_that_first(node: Worked) -> None:
    bring_up(node)
    node.be_busy()
    assert node.trigger_deactivate() is DONE
    assert not node.is_active
    assert node.done == ["create", "resume"]
    node.released.set()
    wait(lambda: node.state is NodeState.INACTIVE)
    assert node.done == ["create", "resume", "pause"]


def test_a_cleanup_that_the_worker_has_no_time_for_is_refused_and_not_done_later(node: Worked) -> None:
    bring_up(node)
    assert node.trigger_deactivate() is DONE
    wait(lambda: node.state is NodeState.INACTIVE)
    node.be_busy()
    assert node.trigger_cleanup() is REFUSED
    node.released.set()
    assert node.call(lambda: list(node.done)) == ["create", "resume", "pause"]
    assert node.trigger_cleanup() is DONE
    assert node.state is NodeState.UNCONFIGURED
    bring_up(node)
    assert node.done == ["create", "resume", "pause", "drop", "create", "resume"]


def test_who_asks_a_busy_worker_in_vain_is_told(node: Worked) -> None:
    node.be_busy()
    with pytest.raises(VliError, match=r"worked_node was busy for 0\.2 s: nothing was done; try again"):
        node.call(lambda: None)


def test_to_pause_a_node_that_does_not_work_is_refused(node: Worked) -> None:
    for ask in (node._pause, node._resume):
        with pytest.raises(VliError, match="worked_node is 'unconfigured', expected ready, paused, finished"):
            ask()
    bring_up(node)
    assert node._pause() == "pausing"
    wait(lambda: node.state is NodeState.PAUSED)
    assert node._resume() == "resuming"
    wait(lambda: node.state is NodeState.READY)


@pytest.mark.parametrize(("is_active", "state"), [(True, NodeState.READY), (False, NodeState.INACTIVE)])
def test_a_new_session_wakes_a_node_that_has_finished_only_where_it_is_active(
    node: Worked, is_active: bool, state: NodeState
) -> None:
    bring_up(node)
    node.set_state(NodeState.FINISHED)
    if not is_active:
        assert node.trigger_deactivate() is DONE
    node.raise_session("again")
    wait(lambda: node.session == 1)
    assert node.state is state


def test_diagnostics_of_two_scanners_have_different_names(node: Worked, monkeypatch: pytest.MonkeyPatch) -> None:
    sent: dict[str, str] = {}
    monkeypatch.setattr(node, "send", lambda topic, message: sent.update({topic.name: message.status[0].name}))
    node.publish_status()
    assert sent == {STATUS.name: "worked_node", DIAGNOSTICS.name: "left/worked_node"}


def test_who_comes_is_answered_at_once_and_only_then(node: Worked, monkeypatch: pytest.MonkeyPatch) -> None:
    answers: list[str] = []
    monkeypatch.setattr(node, "publish_status", lambda: answers.append("status"))
    for started, answered in (("1", 1), ("1", 1), ("2", 2), ("2", 2)):
        status = StageStatus(time.time_ns(), "newcomer", Health.OK, NodeState.READY, "", {"session": "0", "started_ns": started})
        node._on_status(status_to_message(status))
        assert len(answers) == answered


def test_a_destroyed_node_leaves_the_graph_without_a_garbage_collection(
    monkeypatch: pytest.MonkeyPatch, no_collection: None
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init(args=[])
    observer = rclpy.create_node("observer")
    node = Worked()
    name = (node.get_name(), node.get_namespace())
    wait(lambda: name in observer.get_node_names_and_namespaces())
    node.destroy_node()
    wait(lambda: name not in observer.get_node_names_and_namespaces())
    observer.destroy_node()
    rclpy.try_shutdown()
