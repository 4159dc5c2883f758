"""The bookkeeping of a subscription."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from rclpy.subscription import Subscription

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
    """

    topic: Topic
    name: str
    ends: bool
    required: bool
    subscription: Subscription | None = None
    rate: RateMeter = field(default_factory=RateMeter)
    received: int = 0
    last_s: float = field(default_factory=time.monotonic)

    def count(self) -> None:
        """Count a message."""
        self.rate.add()
        self.received += 1
        self.last_s = time.monotonic()

    @property
    def is_unmatched(self) -> bool:
        """True where the node needs the input and nobody publishes it."""
        return self.required and self.subscription is not None and not self.subscription.get_publisher_count()

    def has_ended(self, finished: Mapping[str, Mapping[str, str]]) -> bool:
        """Return True once the source has finished and all that it sent has come.

        Args:
            finished: node → values of its status, of the nodes that have finished.
        """
        (source,) = self.topic.sources
        if source not in finished:
            return False
        sent = int(finished[source].get(f"sent.{self.topic.name}", "0"))
        return self.received >= sent or time.monotonic() - self.last_s > _QUIET_S

    def figures(self, waiting: int) -> dict[str, str]:
        """Return what the status says of it; ``waiting`` messages are in the worker's queue."""
        name = self.topic.name
        return {
            f"rate_hz.{name}": f"{self.rate.read_hz():.1f}",
            f"received.{name}": str(self.received),
            f"waiting.{name}": str(waiting),
        }
