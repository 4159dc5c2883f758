"""What is recorded of one topic: its description, as bags have it, and what came."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from typing import Any

import yaml
from rclpy.duration import Duration, Infinite
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rosbags.typesys import Stores, get_typestore

from vli_common.types import NANOSECONDS

_FOREVER = {"sec": 9223372036, "nsec": 854775807}
"""rosbag2's way to write a duration without end."""


@dataclass(frozen=True, slots=True)
class RawMessage:
    """One message as it came, in CDR.

    Args:
        data: serialised, with the four bytes in front that tell the byte order.
        log_ns: wall clock at its arrival.
        publish_ns: wall clock of the publisher.
        sequence: number that the publisher gave it.
    """

    data: bytes
    log_ns: int
    publish_ns: int
    sequence: int


@dataclass(slots=True)
class RecordedTopic:
    """One topic of a recording.

    Args:
        name: absolute.
        type: ROS interface name.
        depth: of the queue that a player is to offer.
        offers: what its publishers offer, each different profile once.
        messages, size, first_ns, last_ns: of what is in the file; bytes, and log time.
        lost: messages that were published but are not in the file.
    """

    name: str
    type: str
    depth: int
    offers: list[QoSProfile] = field(default_factory=list)
    messages: int = 0
    size: int = 0
    first_ns: int = 0
    last_ns: int = 0
    lost: int = 0

    def add(self, message: RawMessage) -> None:
        """Count a message that was written."""
        self.first_ns = self.first_ns or message.log_ns
        self.last_ns = max(self.last_ns, message.log_ns)
        self.messages += 1
        self.size += len(message.data)

    @property
    def rate_hz(self) -> float:
        """Messages a second between the first and the last, zero for fewer than two."""
        span_s = (self.last_ns - self.first_ns) / NANOSECONDS
        return (self.messages - 1) / span_s if span_s > 0 else 0.0

    @property
    def definition(self) -> str:
        """The message type and all that it contains, in the form of ``.msg`` files."""
        return _definition(self.type)[0]

    @property
    def type_hash(self) -> str:
        """REP 2016's hash of the type."""
        return _definition(self.type)[1]

    @property
    def profiles(self) -> list[dict[str, Any]]:
        """The offered profiles as rosbag2 writes them; history and depth, which no publisher tells, are those of the table."""
        return [_profile(offer, self.depth) for offer in self.offers]

    @property
    def channel_metadata(self) -> dict[str, str]:
        """What rosbag2 keeps with the channel in an mcap file."""
        return {"offered_qos_profiles": yaml.safe_dump(self.profiles, sort_keys=False), "topic_type_hash": self.type_hash}

    @property
    def metadata(self) -> dict[str, Any]:
        """The entry of ``metadata.yaml``, version 9."""
        description = {
            "name": self.name,
            "type": self.type,
            "serialization_format": "cdr",
            "offered_qos_profiles": self.profiles,
            "type_description_hash": self.type_hash,
        }
        return {"topic_metadata": description, "message_count": self.messages}


@cache
def _definition(name: str) -> tuple[str, str]:
    store = get_typestore(Stores.ROS2_JAZZY)
    return store.generate_msgdef(name, ros_version=2)[0], store.hash_rihs01(name)


def _profile(offer: QoSProfile, depth: int) -> dict[str, Any]:
    return {
        "history": "keep_last",
        "depth": depth,
        "reliability": ReliabilityPolicy(offer.reliability).name.lower(),
        "durability": DurabilityPolicy(offer.durability).name.lower(),
        "deadline": _duration(offer.deadline),
        "lifespan": _duration(offer.lifespan),
        "liveliness": LivelinessPolicy(offer.liveliness).name.lower(),
        "liveliness_lease_duration": _duration(offer.liveliness_lease_duration),
        "avoid_ros_namespace_conventions": offer.avoid_ros_namespace_conventions,
    }


def _duration(value: Duration) -> dict[str, int]:
    if value == Infinite or value.nanoseconds >= _FOREVER["sec"] * NANOSECONDS:
        return dict(_FOREVER)
    return {"sec": value.nanoseconds // NANOSECONDS, "nsec": value.nanoseconds % NANOSECONDS}
