"""The graph as seen from outside: poses, windows, states and the status of every node, by their topics."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from vli_bringup.graph import SCANNER, STAGES
from vli_bringup.graph_sessions import GraphSessions
from vli_bringup.latency import FrameLatencies
from vli_bringup.losses import count_of, left_out, undelivered
from vli_bringup.processes import GraphError
from vli_bringup.recorder import Recorder
from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration
from vli_common.errors import MessageError
from vli_common.geometry import inverse
from vli_common.messages import (
    from_time,
    odometry_from_message,
    pose_from_message,
    status_from_message,
    status_to_message,
    window_from_message,
)
from vli_common.node.transport import message_type, quality, set_transport_profile
from vli_common.status import Health, NodeState, StageStatus
from vli_common.topics import NAMESPACE, ODOMETRY, POSE, STATUS, WINDOW, Topic
from vli_common.types import Counters, TrackingState

LISTENER = "replay"
"""Name of the node, for the ``wait_for`` of a driver that shall not play before it hears every stage."""

_SPIN_S = 0.1
_BACK_END = "backend_node"
_NODES = (SCANNER, *(name for _, name in STAGES))
_RECORDED = (POSE, WINDOW, ODOMETRY)


class GraphListener:
    """Collects poses with their covariances, windows and states, session by session; use as a context manager.

    Args:
        calibration: of the scanner.
        latencies: gets when poses came and when the driver's frames were due.
    """

    def __init__(self, calibration: Calibration, latencies: FrameLatencies | None = None) -> None:
        self.statuses: dict[str, StageStatus] = {}
        """The newest status of each node."""
        self.heard_s: dict[str, float] = {}
        """When that came, monotonic seconds."""
        self.sessions = GraphSessions(calibration)
        """What was recorded."""
        self._latencies = latencies or FrameLatencies()
        self._poses: dict[int, tuple[Recorder, FloatArray]] = {}
        self._odometries: dict[int, Odometry] = {}
        self._received = Counters()
        self.malformed = Counters()
        """Messages by topic that were dropped."""
        self.node: Node
        """The listener's own, while it is in the graph."""

    def __enter__(self) -> GraphListener:
        """Join the graph."""
        set_transport_profile()
        rclpy.init(signal_handler_options=rclpy.SignalHandlerOptions.NO)
        self.node = rclpy.create_node(LISTENER, namespace=NAMESPACE)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._publisher = self.node.create_publisher(message_type(STATUS), STATUS.name, quality(STATUS))
        self._subscribe(STATUS, self._on_status)
        handlers: dict[Topic, Callable[..., None]] = {POSE: self._on_pose, WINDOW: self._on_window, ODOMETRY: self._on_odometry}
        self._recorded = {topic: self._subscribe(topic, handle) for topic, handle in handlers.items()}
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown()

    def spin(self) -> None:
        """Handle what comes within a tenth of a second, then say to the driver what is heard."""
        end_s = time.monotonic() + _SPIN_S
        while (left_s := end_s - time.monotonic()) > 0:
            self._executor.spin_once(left_s)
        self._announce()

    def state(self, node: str) -> NodeState | None:
        """Return the state of a node, None where it has not been heard of."""
        status = self.statuses.get(node)
        return None if status is None else status.state

    def value(self, node: str, name: str) -> int:
        """Return a number out of the newest status of a node, zero where it has none of this name."""
        status = self.statuses.get(node)
        return count_of(status.values.get(name, "0")) if status else 0

    def losses(self) -> dict[str, int]:
        """Return ``node.topic`` → messages that never reached their stage.

        Lost on the way (sent by one node, not received by the next), dropped by an overloaded node, malformed, of another
        session, or too early; feedback (``bias``), of which only the newest matters, does not count.
        """
        received = {f"received.{topic.name}": str(self._received[topic.name]) for topic in _RECORDED}
        own = StageStatus(time.time_ns(), LISTENER, Health.OK, NodeState.READY, "", received)
        statuses = list(self.statuses.values())
        return dict(undelivered([*statuses, own]) + left_out(statuses))

    def call(self, service: str, timeout_s: float, is_there: Callable[[], bool] = lambda: True) -> str:
        """Call ``node/service`` (std_srvs/Trigger) and return its answer.

        Args:
            service: of any node.
            timeout_s: for the answer.
            is_there: False once the node has ended; no answer is waited for then.

        Raises:
            GraphError: no answer in time, or a refusal.
        """
        client = self.node.create_client(Trigger, service)
        future = client.call_async(Trigger.Request())
        deadline_s = time.monotonic() + timeout_s
        while not future.done() and time.monotonic() < deadline_s and is_there():
            self.spin()
        if not future.done():
            raise GraphError(f"service '{service}' gave no answer " + (f"in {timeout_s:g} s" if is_there() else "any more"))
        response = future.result()
        if not response.success:
            raise GraphError(f"service '{service}' refused: {response.message}")
        answer: str = response.message
        return answer

    def _announce(self) -> None:
        """Publish a status as the nodes do, once all stages are of one session.

        A stage whose status has come has found this node, and what it will publish arrives; without this, a slow discovery
        loses the first second of poses.
        """
        silent = [name for _, name in STAGES if name not in self.statuses]
        sessions = {self.value(name, "session") for _, name in STAGES}
        if len(sessions) > 1:
            return
        unmatched = [topic.name for topic, reader in self._recorded.items() if not reader.get_publisher_count()]
        values = {"session": str(sessions.pop()), "unmatched": ",".join([*silent, *unmatched])}
        self._publisher.publish(status_to_message(StageStatus(time.time_ns(), LISTENER, Health.OK, NodeState.READY, "", values)))

    def _subscribe(self, topic: Topic, handle: Callable[..., None]) -> Subscription:
        """Subscribe; what is malformed, or says of a node what no node says, is dropped and counted."""

        # With the signature of ``handle``, by which rclpy tells whether to hand over the times of the message.
        @functools.wraps(handle)
        def guarded(*arguments: Any) -> None:
            try:
                handle(*arguments)
            except (MessageError, ValueError, KeyError) as error:
                self.malformed.add(topic.name)
                self.node.get_logger().warning(f"'{topic.name}': {error}", throttle_duration_sec=5.0)

        return self.node.create_subscription(message_type(topic), topic.name, guarded, quality(topic, reading=True))

    def _on_pose(self, message: PoseStamped, info: dict[str, Any]) -> None:
        self._received.add(POSE.name)
        stamp_ns, T_map_imu = pose_from_message(message)
        self._latencies.add_pose(stamp_ns, int(info["received_timestamp"]))
        recorder = self.sessions.at(int(info["source_timestamp"]))
        recorder.add_pose(stamp_ns, T_map_imu)
        self._poses[stamp_ns] = recorder, T_map_imu
        self._join(stamp_ns)

    def _on_odometry(self, message: Odometry) -> None:
        self._received.add(ODOMETRY.name)
        stamp_ns = from_time(message.header.stamp)
        self._odometries[stamp_ns] = message
        self._join(stamp_ns)

    def _join(self, stamp_ns: int) -> None:
        """Record the covariance, which the odometry has about the axes of ``odom``, once the pose in ``map`` is there too."""
        if stamp_ns not in self._poses or stamp_ns not in self._odometries:
            return
        (recorder, T_map_imu), message = self._poses.pop(stamp_ns), self._odometries.pop(stamp_ns)
        T_odom_imu = odometry_from_message(message).T_map_imu
        estimate = odometry_from_message(message, T_map_imu @ inverse(T_odom_imu))
        recorder.add_pose(stamp_ns, T_map_imu, estimate.covariance)

    def _on_window(self, message: Any, info: dict[str, Any]) -> None:
        self._received.add(WINDOW.name)
        window = window_from_message(message)
        self.sessions.of_window(window.session, int(info["source_timestamp"])).add([window])

    def _on_status(self, message: Any, info: dict[str, Any]) -> None:
        status = status_from_message(message)
        if status.node not in _NODES:
            return
        self.statuses[status.node], self.heard_s[status.node] = status, time.monotonic()
        if "due_stamp_ns" in status.values:
            self._latencies.add_due(int(status.values["due_stamp_ns"]), int(status.values["due_wall_ns"]))
        values = status.values
        if status.node == _BACK_END:
            self.sessions.begin(count_of(values.get("session", "0")), int(info["source_timestamp"]))
        if status.node == _BACK_END and "tracking" in values:
            self.sessions.recorder.add_state(int(values["stamp_ns"]), TrackingState(values["tracking"]), values["reason"])
