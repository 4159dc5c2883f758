"""A subscription that takes messages as bytes, matches every publisher, and knows what it missed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from vli_bringup.recording.topic import RawMessage, RecordedTopic
from vli_common.node.transport import message_type
from vli_common.topics import Topic

_DEPTH_FACTOR = 16
"""Messages that may wait for this process, in depths of the publisher."""

Put = Callable[[RecordedTopic, RawMessage], object]


class RawSubscription:
    """Hears one topic, reliably where all its publishers are reliable.

    Args:
        node: that subscribes.
        topic: of the table, or like one.
        name: to subscribe to.
        put: gets every message.
    """

    def __init__(self, node: Node, topic: Topic, name: str, put: Put) -> None:
        self.recorded = RecordedTopic(node.resolve_topic_name(name), topic.type, topic.depth)
        self.publishers = 0
        self._node, self._topic, self._put = node, topic, put
        self._last: int | None = None
        self._profile = _profile(topic.depth, True, topic.transient_local)
        self._misfit: dict[str, str] = {}
        self._told_types: set[str] = set()
        self._subscription: Subscription | None = self._subscribe()

    @property
    def is_closed(self) -> bool:
        """True once nothing more is heard."""
        return self._subscription is None

    def adapt(self) -> Iterator[str]:
        """Look who publishes, and subscribe anew where that asks for another profile; yield what is to be told."""
        if self._subscription is None:
            return
        fitting = self._look()
        yield from self._misfits()
        if not fitting:
            return
        reliable = all(item.qos_profile.reliability is ReliabilityPolicy.RELIABLE for item in fitting)
        durable = all(item.qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL for item in fitting)
        if (reliable, durable) == (self._is_reliable, self._is_durable):
            return
        if self._is_reliable and not reliable:
            yield f"'{self.recorded.name}' is published as best effort: messages may be lost; what is lost is counted"
        self._node.destroy_subscription(self._subscription)
        self._profile = _profile(self._topic.depth, reliable, durable)
        self._subscription = self._subscribe()

    def close(self) -> None:
        """Take what has come, and hear nothing more."""
        if self._subscription is None:
            return
        self._take_all()
        self._node.destroy_subscription(self._subscription)
        self._subscription = None

    @property
    def _is_reliable(self) -> bool:
        return self._profile.reliability is ReliabilityPolicy.RELIABLE

    @property
    def _is_durable(self) -> bool:
        return self._profile.durability is DurabilityPolicy.TRANSIENT_LOCAL

    def _subscribe(self) -> Subscription:
        kind = message_type(self._topic)
        take: Any = self._on_message  # rclpy's types know of no second argument.
        # Profiles that do not match are looked for by :meth:`adapt`; rclpy would only log them.
        events = SubscriptionEventCallbacks(use_default_callbacks=False)
        return self._node.create_subscription(kind, self.recorded.name, take, self._profile, raw=True, event_callbacks=events)

    def _look(self) -> list[TopicEndpointInfo]:
        """Return the publishers of the right type, and remember what they offer."""
        found = self._node.get_publishers_info_by_topic(self.recorded.name)
        fitting = [item for item in found if item.topic_type == self._topic.type]
        self._misfit = {item.topic_type: item.node_name for item in found if item not in fitting}
        self.publishers = len(fitting)
        for item in fitting:
            if item.qos_profile not in self.recorded.offers:
                self.recorded.offers.append(item.qos_profile)
        return fitting

    def _on_message(self, data: bytes, info: dict[str, Any]) -> None:
        self._accept(data, info)
        self._take_all()

    def _take_all(self) -> None:
        """Take what waits already, without a round through the executor for each."""
        if self._subscription is None:
            return
        with self._subscription.handle:
            while (taken := self._subscription.handle.take_message(self._subscription.msg_type, True)) is not None:
                self._accept(*taken)

    def _accept(self, data: bytes, info: dict[str, Any]) -> None:
        if not self.recorded.offers:
            self._look()
        sequence = int(info["publication_sequence_number"] or 0)
        # Numbers of several publishers are mixed; one that starts anew counts from the beginning.
        if self._last is not None and sequence > self._last + 1 and self.publishers == 1:
            self.recorded.lost += sequence - self._last - 1
        self._last = sequence
        log_ns = int(info["received_timestamp"])
        self._put(self.recorded, RawMessage(data, log_ns, int(info["source_timestamp"]) or log_ns, sequence % 2**32))

    def _misfits(self) -> Iterator[str]:
        for kind, node in self._misfit.items():
            if kind not in self._told_types:
                self._told_types.add(kind)
                yield f"'{self.recorded.name}' of {node} has type '{kind}', expected '{self._topic.type}': it is not recorded"


def _profile(depth: int, reliable: bool, durable: bool) -> QoSProfile:
    return QoSProfile(
        depth=_DEPTH_FACTOR * depth,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if durable else DurabilityPolicy.VOLATILE,
    )
