"""What runs the callbacks of a node: rclpy's executor of events, or the one with a wait set where rclpy has no other.

A round of the wait set builds it anew, in Python, from every entity of the node, and hands over one message: more work than that
on most messages. The executor of events is called by the middleware.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol

from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.task import Future

try:
    from rclpy.experimental import EventsExecutor
except ImportError:  # rclpy before 7.1.4
    EventsExecutor = None  # type: ignore[assignment]

_REST_S = 2e-3
"""What comes in this time is taken in one round of the wait set, see :meth:`WaitSetSpinner.receiver`."""


class Spinner(Protocol):
    """Runs the callbacks of one node in the thread that calls :meth:`spin`."""

    def __init__(self, node: Node) -> None: ...

    def spin(self, seconds: float) -> None:
        """Run callbacks; return after about so long, or before.

        A handler of signals that is written in Python runs when this returns.
        """
        ...

    def close(self) -> None:
        """Let go of the node."""
        ...

    @staticmethod
    def receiver(accept: Callable[[Any], None], subscription: Callable[[], Subscription | None]) -> Callable[[Any], None]:
        """Return the callback of a subscription whose messages ``accept`` takes."""
        ...


class _ExecutorSpinner:
    """An executor of rclpy with one node.

    Args:
        executor: that runs the callbacks.
        node: whose callbacks are run.
    """

    def __init__(self, executor: Executor, node: Node) -> None:
        self._executor = executor
        self._executor.add_node(node)

    def close(self) -> None:
        """Let go of the node."""
        self._executor.shutdown(timeout_sec=0)


class EventSpinner(_ExecutorSpinner):
    """Sleeps until the middleware has something.

    Args:
        node: whose callbacks are run.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(EventsExecutor(), node)

    def spin(self, seconds: float) -> None:
        """Run callbacks for so long."""
        # Its spin() would never come back to let Python handle a signal; its spin_once() would do so for every message.
        self._executor.spin_until_future_complete(Future(), seconds)

    @staticmethod
    def receiver(accept: Callable[[Any], None], subscription: Callable[[], Subscription | None]) -> Callable[[Any], None]:
        """Return ``accept``: it is called for every message."""
        return accept


class WaitSetSpinner(_ExecutorSpinner):
    """Waits for a set of all entities of the node.

    Args:
        node: whose callbacks are run.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(SingleThreadedExecutor(), node)

    def spin(self, seconds: float) -> None:
        """Run one callback, then let others gather."""
        self._executor.spin_once(timeout_sec=seconds)
        time.sleep(_REST_S)

    @staticmethod
    def receiver(accept: Callable[[Any], None], subscription: Callable[[], Subscription | None]) -> Callable[[Any], None]:
        """Return a callback that also takes what waits in the subscription already, without another round."""

        def callback(message: Any) -> None:
            accept(message)
            waiting = subscription()
            if waiting is None:
                return
            with waiting.handle:
                while (taken := waiting.handle.take_message(waiting.msg_type, waiting.raw)) is not None:
                    accept(taken[0])

        return callback


SPINNER: type[Spinner] = WaitSetSpinner if EventsExecutor is None else EventSpinner
"""Of this rclpy."""
