"""Messages that never reached their stage, by what the nodes say of themselves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection

from vli_common.status import StageStatus
from vli_common.topics import BIAS

_DROPPED = ("dropped", "node")


def undelivered(statuses: Collection[StageStatus]) -> Counter[str]:
    """Return ``node.topic`` → messages that were sent by one node and not received by the next.

    Feedback (``bias``), of which only the newest matters, does not count.

    Args:
        statuses: of nodes that are at rest in the same session.
    """
    values = [item for status in statuses for item in status.values.items()]
    sent = {key.removeprefix("sent."): count_of(value) for key, value in values if key.startswith("sent.")}
    return _positive(
        {f"{node}.{name}": sent.get(name, 0) - count for node, kind, name, count in _counts(statuses) if kind == "received"}
    )


def left_out(statuses: Collection[StageStatus]) -> Counter[str]:
    """Return ``node.topic`` → messages that came and were not handled, since the node runs.

    Dropped by an overloaded node, malformed, of another session, or too early.
    """
    lost: Counter[str] = Counter()
    for node, kind, name, count in _counts(statuses):
        if kind in _DROPPED:
            lost[f"{node}.{name}"] += count
    return _positive(lost)


def count_of(text: str) -> int:
    """Return a whole number out of a status, zero where there is none."""
    try:
        return int(float(text))
    except (ValueError, OverflowError):
        return 0


def _counts(statuses: Collection[StageStatus]) -> list[tuple[str, str, str, int]]:
    """Return node, kind, name and number of all that counts, by node."""
    ordered = sorted(statuses, key=lambda status: status.node)
    items = [(status.node, *key.partition("."), value) for status in ordered for key, value in status.values.items()]
    return [(node, kind, name, count_of(value)) for node, kind, _, name, value in items if name != BIAS.name]


def _positive(counts: dict[str, int]) -> Counter[str]:
    return Counter({name: count for name, count in counts.items() if count > 0})
