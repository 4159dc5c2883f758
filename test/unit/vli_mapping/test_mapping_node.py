"""The mapping node under overload: what waits for its worker."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import rclpy

from vli_common.messages import image_to_cdr, scan_to_message
from vli_common.topics import IMAGE_LONG, LASER_POINTS
from vli_common.types import Image, LaserScan
from vli_mapping.nodes.mapping_node import MappingNode

BEHIND_S = 8
LONG_HZ = 30


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Iterator[MappingNode]:
    """Return a node whose worker has not begun: everything waits."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init(args=[])
    item = MappingNode()
    yield item
    item.destroy_node()
    rclpy.try_shutdown()


def dropped(node: MappingNode) -> dict[str, str]:
    node.publish_status()
    values = node.others["mapping_node"].values
    return {name: value for name, value in values.items() if name.startswith(("dropped.", "waiting."))}


def callback(node: MappingNode, topic: str):
    (found,) = (item.callback for item in node.subscriptions if item.topic_name.endswith(f"/{topic}"))
    return found


def test_a_mapper_that_is_eight_seconds_behind_loses_no_colour(node):
    receive = callback(node, IMAGE_LONG.name)
    for stamp_ns in range(BEHIND_S * LONG_HZ):
        receive(image_to_cdr(Image(stamp_ns, np.zeros((4, 4, 3), np.uint8))))
    values = dropped(node)
    assert values["waiting.image_long"] == str(BEHIND_S * LONG_HZ)
    assert "dropped.image_long" not in values


def test_what_waits_is_bounded_and_what_goes_is_counted(node):
    receive = callback(node, LASER_POINTS.name)
    for stamp_ns in range(500):
        receive(scan_to_message(LaserScan.empty(stamp_ns)))
    values = dropped(node)
    assert int(values["waiting.laser_points"]) + int(values["dropped.laser_points"]) == 500
    assert int(values["waiting.laser_points"]) == 12 * LASER_POINTS.depth
