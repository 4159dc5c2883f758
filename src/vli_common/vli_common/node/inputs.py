"""A subscription that matches its publisher, and its bookkeeping."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from vli_common import cdr
from vli_common.node.transport import message_type, quality
from vli_common.reception import Reception
from vli_common.status import RateMeter
from vli_common.topics import Topic

_QUIET_S = 1.0
"""An input that fell short of what its source sent is given up after this long without a message."""


@dataclass
class Input:
    """One subscription: what came, and whether more is to come.

    Args:
        topic: of the table.
        name: it is subscribed under.
        ends: False for feedback, which does not tell the end of the input.
        required: False for an input that may have no publisher.
        sheds: messages in a row that are dropped at a time under overload.
    """

    topic: Topic
    name: str
    ends: bool
    required: bool
    sheds: int = 0
    subscription: Subscription | None = None
    rate: RateMeter = field(default_factory=RateMeter)
    received: int = 0
    last_s: float = field(default_factory=time.monotonic)
    cut_off: str = ""
    """That nothing comes of what another node sends, in words; empty where something does."""
    _reception: Reception = field(default_factory=Reception)
    _is_mismatched: bool = False
    _left_to_shed: int = 0

    def subscribe(self, node: Node, callback: Callable[[Any], None], profile: QoSProfile | None = None) -> None:
        """Subscribe, reliably unless ``profile`` says otherwise."""

        def note(_: object) -> None:
            self._is_mismatched = True

        self.subscription = node.create_subscription(
            message_type(self.topic),
            self.name,
            callback,
            profile or quality(self.topic, reading=True),
            raw=self.topic.type in cdr.READERS,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=note, use_default_callbacks=False),
        )

    def decoded(self, message: Any) -> Any:
        """Return the fields of what came; rclpy takes several times as long to make a message of a sample or an image.

        Raises:
            MessageError: bytes that are no such message.
        """
        reader = cdr.READERS.get(self.topic.type)
        return message if reader is None else cdr.read(reader, message)

    def adapt(self, node: Node, callback: Callable[[Any], None]) -> str | None:
        """Subscribe anew where a publisher offers less than was asked for; return what to say of it, None where all match.

        A best-effort publisher never reaches a reliable reader; a best-effort reader hears everybody.
        """
        if not self._is_mismatched or self.subscription is None:
            return None
        self._is_mismatched = False
        asked = self.subscription.qos_profile
        offers = [item for item in node.get_publishers_info_by_topic(self.name) if not _serves(item.qos_profile, asked)]
        profile = quality(self.topic, reading=True)
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
        node.destroy_subscription(self.subscription)
        self.subscribe(node, callback, profile)
        named = ", ".join(f"'{item.node_name}' offers {_text(item.qos_profile)}" for item in offers) or "a publisher offers less"
        return f"'{self.name}': {named}, {_text(asked)} was asked for; heard as best effort from now on, messages may be lost"

    def count(self) -> None:
        """Count a message."""
        self.rate.add()
        self.received += 1
        self.last_s = time.monotonic()

    def note_sent(self, node: str, sent: int, session: int) -> None:
        """Compare with what another node of the same session says it has sent."""
        missed = self._reception.missed(str(session), self.received, sent, time.monotonic())
        self.cut_off = (
            f"cut off: nothing has come of {missed} messages of '{node}' on '{self.name}'; start this node again, else that one"
            if missed
            else ""
        )

    def is_shed(self, is_behind: bool) -> bool:
        """Return True where the next message is to be dropped."""
        if is_behind and not self._left_to_shed:
            self._left_to_shed = self.sheds
        if not self._left_to_shed:
            return False
        self._left_to_shed -= 1
        return True

    @property
    def is_unmatched(self) -> bool:
        """True where the node needs the input and nobody publishes it."""
        return self.required and self.subscription is not None and not self.subscription.get_publisher_count()

    def has_ended(self, finished: Mapping[str, Mapping[str, str]]) -> bool:
        """Return True once the source has finished and all that it sent has come: as many as it says, or no more for a second.

        They differ where a message was lost, and where either side was started anew and counts from then on.

        Args:
            finished: node → values of its status, of the nodes that have finished.
        """
        (source,) = self.topic.sources
        if source not in finished:
            return False
        # As text: what a status says need not be a number.
        sent = finished[source].get(f"sent.{self.topic.name}", "0")
        return str(self.received) == sent or time.monotonic() - self.last_s > _QUIET_S

    def figures(self, waiting: int) -> dict[str, str]:
        """Return what the status says of it; ``waiting`` messages are in the worker's queue."""
        name = self.topic.name
        return {
            f"rate_hz.{name}": f"{self.rate.read_hz():.1f}",
            f"received.{name}": str(self.received),
            f"waiting.{name}": str(waiting),
        }


def _serves(offered: QoSProfile, asked: QoSProfile) -> bool:
    reliable = asked.reliability is not ReliabilityPolicy.RELIABLE or offered.reliability is ReliabilityPolicy.RELIABLE
    return reliable and offered.durability.value <= asked.durability.value


def _text(profile: QoSProfile) -> str:
    return f"{profile.reliability.name.lower().replace('_', ' ')} {profile.durability.name.lower().replace('_', ' ')}"
