"""Both executors run everything that a node consists of, and come back in time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import Trigger

from vli_common.errors import VliError
from vli_common.node import executor
from vli_common.node.executor import EventSpinner, Spinner, WaitSetSpinner
from vli_common.node.working import WorkingNode

SPINNERS = [
    WaitSetSpinner,
    pytest.param(EventSpinner, marks=pytest.mark.skipif(executor.EventsExecutor is None, reason="old rclpy")),
]
SPIN_S = 0.05


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Iterator[WorkingNode]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init(args=[])
    made = WorkingNode("spun_node")
    yield made
    assert made.close()
    made.destroy_node()
    rclpy.try_shutdown()


def spin_until(spinner: Spinner, condition: Callable[[], Any], timeout_s: float = 10.0) -> bool:
    end_s = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < end_s:
        spinner.spin(SPIN_S)
    return bool(condition())


def listen(kind: type[Spinner], node: WorkingNode, topic: str, heard: list[str]) -> Any:
    made: list[Any] = []
    callback = kind.receiver(lambda message: heard.append(message.data), lambda: made[0])
    made.append(node.create_subscription(String, topic, callback, 100))
    return made[0]


@pytest.mark.parametrize("kind", SPINNERS)
def test_every_message_comes_once_and_in_order_also_on_a_subscription_that_is_made_late(kind, node):
    early, late = [], []
    publishers = [node.create_publisher(String, topic, 100) for topic in ("early", "late")]
    listen(kind, node, "early", early)
    spinner = kind(node)
    spinner.spin(SPIN_S)
    subscription = listen(kind, node, "late", late)
    assert spin_until(spinner, lambda: all(publisher.get_subscription_count() for publisher in publishers))
    texts = [str(number) for number in range(50)]
    for publisher in publishers:
        for text in texts:
            publisher.publish(String(data=text))
    assert spin_until(spinner, lambda: len(early) == len(late) == len(texts))
    assert early == late == texts
    node.destroy_subscription(subscription)
    spinner.spin(SPIN_S)
    publishers[1].publish(String(data="nobody listens"))
    publishers[0].publish(String(data="the end"))
    assert spin_until(spinner, lambda: early[-1] == "the end")
    assert late == texts
    spinner.close()


@pytest.mark.parametrize("kind", SPINNERS)
def test_a_timer_keeps_its_period(kind, node):
    calls: list[float] = []
    node.every(0.02, lambda: calls.append(time.monotonic()))
    spinner = kind(node)
    assert spin_until(spinner, lambda: len(calls) > 10)
    # One call that comes late brings the others nearer to it.
    assert calls[10] - calls[0] > 0.1
    spinner.close()


@pytest.mark.parametrize("kind", SPINNERS)
def test_a_service_that_takes_long_is_answered_in_the_end_and_others_meanwhile(kind, node):
    asked = threading.Event()

    def wait() -> str:
        if not asked.wait(10.0):
            raise VliError("in vain")
        return "waited"

    def fail() -> str:
        raise VliError("refused")

    def answer() -> str:
        asked.set()
        return "asked"

    node.serve("slow", wait, aside=True)
    node.serve("failing", fail, aside=True)
    node.serve("quick", answer)
    clients = [node.create_client(Trigger, f"~/{name}") for name in ("slow", "failing", "quick")]
    spinner = kind(node)
    assert spin_until(spinner, lambda: all(client.service_is_ready() for client in clients))
    answers = [client.call_async(Trigger.Request()) for client in clients]
    assert spin_until(spinner, lambda: all(answer.done() for answer in answers))
    assert [(answer.result().success, answer.result().message) for answer in answers] == [
        (True, "waited"),
        (False, "refused"),
        (True, "asked"),
    ]
    spinner.close()


@pytest.mark.parametrize("kind", SPINNERS)
def test_the_life_of_a_node_is_managed_by_services(kind, node):
    client = node.create_client(ChangeState, "~/change_state")
    spinner = kind(node)
    assert spin_until(spinner, client.service_is_ready)
    for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
        answer = client.call_async(ChangeState.Request(transition=Transition(id=transition)))
        assert spin_until(spinner, answer.done)
        assert answer.result().success
    assert node.is_active
    spinner.close()


@pytest.mark.parametrize("kind", SPINNERS)
def test_a_publisher_that_does_not_match_is_told(kind, node):
    told: list[Any] = []
    events = SubscriptionEventCallbacks(incompatible_qos=told.append, use_default_callbacks=False)
    node.create_subscription(String, "topic", lambda _: None, 10, event_callbacks=events)
    spinner = kind(node)
    node.create_publisher(String, "topic", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    assert spin_until(spinner, lambda: told)
    spinner.close()


@pytest.mark.parametrize("kind", SPINNERS)
def test_what_a_callback_raises_is_raised_to_who_spins(kind, node):
    def fail() -> None:
        raise ZeroDivisionError

    node.every(0.01, fail)
    spinner = kind(node)
    with pytest.raises(ZeroDivisionError):
        spin_until(spinner, lambda: False)
    spinner.close()


@pytest.mark.parametrize("kind", SPINNERS)
def test_a_node_at_rest_is_left_in_time(kind, node):
    spinner = kind(node)
    begin_s = time.monotonic()
    for _ in range(5):
        spinner.spin(SPIN_S)
    assert time.monotonic() - begin_s < 5.0
    spinner.close()
