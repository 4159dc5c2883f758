"""What was lost between nodes, by what they say of themselves."""

from __future__ import annotations

import pytest

from vli_bringup.losses import count_of, left_out, undelivered
from vli_common.status import Health, NodeState, StageStatus


def status(node: str, values: dict[str, str]) -> StageStatus:
    return StageStatus(0, node, Health.OK, NodeState.FINISHED, "", values)


def test_what_one_node_has_sent_and_the_next_has_not_received_is_lost_and_feedback_is_not() -> None:
    back_end = status("backend_node", {"sent.window": "3", "sent.bias": "9"})
    mapping = status("mapping_node", {"received.window": "1", "received.image_long": "4"})
    front_end = status("frontend_node", {"received.bias": "1", "dropped.image_long": "7"})
    assert undelivered([mapping, back_end, front_end]) == {"mapping_node.window": 2}


def test_what_a_node_has_left_out_is_added_up_whatever_the_cause() -> None:
    values = {"dropped.image_long": "2", "node.image_long": "1", "node.tracks_malformed": "4", "dropped.imu": "0", "node.x": "-"}
    assert left_out([status("frontend_node", values)]) == {"frontend_node.image_long": 3, "frontend_node.tracks_malformed": 4}


@pytest.mark.parametrize(("text", "count"), [("7", 7), ("7.9", 7), ("1e999", 0), ("", 0), ("many", 0), ("nan", 0)])
def test_what_is_no_number_counts_nothing(text: str, count: int) -> None:
    assert count_of(text) == count
