"""A node with topics, services and a worker; what it is of the graph, :class:`vli_common.node.base.VliNode` knows.

Callbacks only enqueue; a worker thread decodes and computes, so that 25 ms of work on an image never holds up the IMU.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from typing import Any, TypeVar

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidHandle
from rclpy.publisher import Publisher
from std_srvs.srv import Trigger

from vli_common.errors import VliError
from vli_common.node.aside import Aside
from vli_common.node.executor import SPINNER
from vli_common.node.inputs import Input
from vli_common.node.lifecycle import ManagedNode
from vli_common.node.transport import message_type, quality
from vli_common.node.worker import Worker
from vli_common.topics import NAMESPACE, Topic
from vli_common.types import Counters

T = TypeVar("T")

_QUEUE_DEPTHS = 12
"""The worker's queue holds this many times the depth of the topic."""
_ASIDE_S = 7.0
"""A service under way, a map that is being saved, gets this long to end when the node is stopped: who stops nodes (``vli``,
``ros2 launch``) kills those that have not ended after ten seconds."""
_STOP_S = 1.0
"""So does what the worker is doing; to compile a kernel cannot be interrupted."""
_CALL_S = 10.0
_JOB_S = 60.0


class WorkingNode(ManagedNode):
    """Publishers, subscriptions and services by the table of topics, and the worker in which messages are handled.

    Args:
        name: of the executable.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name, NAMESPACE)
        self._worker = Worker(name, self.fail)
        self._aside = Aside(name)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._inputs: dict[str, Input] = {}
        self._matchers: list[Callable[[], str | None]] = []
        self._publishers_by_topic: dict[str, Publisher] = {}
        self._sent = Counters()

    def fail(self, error: Exception) -> None:
        """A job of the worker raised."""
        raise NotImplementedError

    def _process(
        self, entry: Input, read: Callable[[Any], T], handle: Callable[[T], None], message: Any, arrived_s: float
    ) -> None:
        """Handle a message that came at ``arrived_s``, monotonic; runs in the worker."""
        raise NotImplementedError

    def receive(
        self,
        topic: Topic,
        read: Callable[[Any], T],
        handle: Callable[[T], None],
        name: str | None = None,
        ends: bool = True,
        required: bool = True,
        limit: int | None = None,
        sheds: int = 0,
    ) -> None:
        """Subscribe; ``read`` and ``handle`` run in the worker.

        Args:
            topic: of the table.
            read: message → type; what it refuses is dropped and counted. It gets what :mod:`vli_common.cdr` reads where that can.
            handle: gets what is of the present session.
            name: to subscribe to in place of the topic's own.
            ends: False for feedback, which does not tell the end of the input.
            required: False for an input that may have no publisher.
            limit: messages that may wait for the worker, by default 12 times the depth of the topic.
            sheds: of this topic, so many in a row are dropped at a time while the worker is behind for good; 0: none.
        """
        entry = Input(topic, name or topic.name, ends, required, sheds)
        most = limit or _QUEUE_DEPTHS * topic.depth

        def read_decoded(message: Any) -> T:
            return read(entry.decoded(message))

        def accept(message: Any) -> None:
            entry.count()
            self._worker.put(topic.name, partial(self._process, entry, read_decoded, handle, message, entry.last_s), most)

        callback = SPINNER.receiver(accept, lambda: entry.subscription)
        entry.subscribe(self, callback)
        self._inputs[topic.name] = entry
        self._matchers.append(partial(entry.adapt, self, callback))

    def received(self, topic: Topic) -> int:
        """Return how many messages of a topic of :meth:`receive` have come in this session."""
        return self._inputs[topic.name].received

    def advertise(self, topic: Topic, name: str | None = None) -> Publisher:
        """Make the publisher of a topic, for :meth:`send`."""
        publisher = self.create_publisher(message_type(topic), name or topic.name, quality(topic))
        self._publishers_by_topic[topic.name] = publisher
        return publisher

    def send(self, topic: Topic, message: Any) -> None:
        """Publish, and count for those downstream; a node that is being stopped publishes nothing more."""
        self._sent.add(topic.name)
        try:
            self._publishers_by_topic[topic.name].publish(message)
        except Exception:
            if rclpy.ok():
                raise

    def has_listener(self, topic: Topic) -> bool:
        """Return True where anyone subscribes to a topic of :meth:`advertise`."""
        return bool(self._publishers_by_topic[topic.name].get_subscription_count())

    def serve(self, name: str, action: Callable[[], str], aside: bool = False) -> None:
        """Offer the service ``~/name`` (std_srvs/Trigger), answered with what ``action`` returns or raises.

        Args:
            name: of the service.
            action: what it does.
            aside: run it in a thread of its own, since it takes long: messages are taken meanwhile. One at a time.
        """

        def answer(_: Trigger.Request, response: Trigger.Response) -> Any:
            job = partial(_answered, response, action)
            return self.do_aside(job) if aside else job()

        service = self.create_service(Trigger, f"~/{name}", answer)
        if aside:
            service.send_response = partial(_send_when_done, service.send_response)  # type: ignore[method-assign]

    def do_aside(self, action: Callable[[], T]) -> Future[T]:
        """Do what takes long in the thread of such services, which is given time to end when the node is stopped."""
        return self._aside.run(action)

    def every(self, period_s: float, action: Callable[[], None]) -> None:
        """Run an action in the executor again and again, by the machine's own clock.

        With ``use_sim_time`` the clock of ROS stands still while nobody plays: a node must answer all the same.
        """
        self.create_timer(period_s, action, clock=self._steady)

    def enqueue(self, job: Callable[[], None]) -> None:
        """Run a job in the worker, after all that waits there."""
        self._worker.control(job)

    def call(self, job: Callable[[], T]) -> T:
        """Run a job in the worker, after all that waits there, and return its result; for services.

        Raises:
            VliError: the worker did not come to it in 10 s, and will not any more, or was still at it after another 60 s.
            Exception: what the job raised.
        """
        future: Future[T] = Future()

        def run() -> None:
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(job())
            except Exception as error:
                future.set_exception(error)

        self.enqueue(run)
        with suppress(TimeoutError):
            return future.result(_CALL_S)
        if future.cancel():
            raise VliError(f"{self.get_name()} was busy for {_CALL_S:g} s: nothing was done; try again")
        try:
            return future.result(_JOB_S)
        except TimeoutError as error:
            raise VliError(f"{self.get_name()} is still at it after {_CALL_S + _JOB_S:g} s") from error

    @staticmethod
    def existing(stage: T | None) -> T:
        """Return a stage object, which is made before anything is handled.

        Raises:
            VliError: it is not there yet.
        """
        if stage is None:
            raise VliError("the node is not ready: no calibration yet")
        return stage

    def close(self) -> bool:
        """End the node's own threads, after the services under way; return False where a job would not end.

        Nothing comes in any more; the node itself is there until it is destroyed.
        """
        self._aside.finish(_ASIDE_S)
        return self._worker.stop(_STOP_S)

    def _unmatched(self) -> str:
        return ",".join(entry.name for entry in self._inputs.values() if entry.is_unmatched)

    def _match(self) -> None:
        for match in self._matchers:
            if text := match():
                self.get_logger().warning(text)


def _answered(response: Trigger.Response, action: Callable[[], str]) -> Trigger.Response:
    try:
        response.message = action()
        response.success = True
    except Exception as error:
        response.success, response.message = False, str(error)
    return response


def _send_when_done(send: Callable[[Trigger.Response, Any], None], answer: Future[Trigger.Response], header: Any) -> None:
    """Send what a service answers once it is there.

    To await it in the callback would not do: rclpy's executor of events takes no coroutines for services, and the other one runs
    nothing else of the node meanwhile.
    """

    def deliver(done: Future[Trigger.Response]) -> None:
        # The node may have been stopped by then.
        with suppress(InvalidHandle):
            send(done.result(), header)

    answer.add_done_callback(deliver)
