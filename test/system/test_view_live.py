"""``vli view --live``: a viewer that comes late sees the map, and ends as it should."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from tiny_bag import CALIBRATION

from vli_bringup.viewing.live_listener import LiveListener
from vli_common.calibration import to_yaml
from vli_common.geometry import inverse, pose
from vli_common.messages import cloud_to_message, path_to_message, pose_to_message, status_to_message
from vli_common.node.transport import message_type, quality, set_transport_profile
from vli_common.status import Health, NodeState, StageStatus
from vli_common.topics import CALIBRATION as CALIBRATION_TOPIC
from vli_common.topics import CLOUD, MAP, MAP_UPDATE, NAMESPACE, PATH, POSE, STATUS, Topic
from vli_common.types import PointCloud, PoseEstimate

pytestmark = pytest.mark.graph
_WAIT_S = 60.0


class Heard:
    """A display that remembers."""

    def __init__(self) -> None:
        self.values: dict[str, Any] = {}

    def __getattr__(self, name: str) -> Callable[[Any], None]:
        return lambda value: self.values.__setitem__(name, value)


@pytest.fixture
def graph() -> Iterator[Node]:
    """Return a node of a process of its own, as far as the middleware can tell."""
    set_transport_profile()
    context = Context()
    rclpy.init(context=context)
    node = rclpy.create_node("mapping_node", namespace=NAMESPACE, context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


def cloud(count: int) -> PointCloud:
    points = np.arange(3 * count, dtype=np.float32).reshape(count, 3)
    return PointCloud(5, points, np.full((count, 3), 7, np.uint8), np.zeros((count, 3), np.float32), np.ones(count, np.float32))


def estimate(T_map_imu: np.ndarray) -> PoseEstimate:
    zeros = np.zeros(3)
    return PoseEstimate(5, T_map_imu, np.eye(4), zeros, zeros, np.eye(6))


def test_a_viewer_that_comes_late_gets_calibration_and_map_and_then_all_that_follows(graph: Node) -> None:
    def publisher(topic: Topic) -> Any:
        return graph.create_publisher(message_type(topic), topic.name, quality(topic))

    T_cam_imu = pose(np.eye(3), np.array([0.0, 0.0, -0.01]))
    document = {**CALIBRATION, "cam0": {**CALIBRATION["cam0"], "T_cam_imu": T_cam_imu.tolist()}}
    publisher(CALIBRATION_TOPIC).publish(String(data=to_yaml(document)))
    publisher(MAP).publish(cloud_to_message(cloud(1000)))
    display = Heard()
    with LiveListener(display) as listener:
        others = {topic: publisher(topic) for topic in (MAP_UPDATE, CLOUD, PATH, POSE, STATUS)}
        message = pose_to_message(estimate(np.eye(4)))
        status = StageStatus(0, "backend_node", Health.OK, NodeState.READY, "move slower")
        deadline_s = time.monotonic() + _WAIT_S
        wanted = {"add_map", "add_update", "add_stripes", "add_path", "add_pose", "add_status"}

        def has_all() -> bool:
            return wanted <= set(display.values) and np.allclose(display.values["add_pose"], inverse(T_cam_imu))

        while not has_all() or not listener.counters["cloud_malformed"]:
            assert time.monotonic() < deadline_s, (display.values, listener.counters)
            others[MAP_UPDATE].publish(cloud_to_message(cloud(20)))
            others[CLOUD].publish(cloud_to_message(cloud(4)))
            others[CLOUD].publish(PointCloud2())
            others[PATH].publish(path_to_message([message, message]))
            others[POSE].publish(message)
            others[STATUS].publish(status_to_message(status))
            listener.spin(0.2)
    np.testing.assert_array_equal(display.values["add_map"].points, cloud(1000).points)
    assert (len(display.values["add_update"]), len(display.values["add_stripes"])) == (20, 4)
    assert display.values["add_path"].shape == (2, 4, 4)
    assert display.values["add_status"].hint == "move slower"


def test_the_command_serves_until_it_is_told_to_stop(graph: Node) -> None:
    pytest.importorskip("viser")
    with socket.socket() as item:
        item.bind(("127.0.0.1", 0))
        port = item.getsockname()[1]
    command = [sys.executable, "-m", "vli_bringup.cli", "view", "--live", "--no-browser", "--port", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        line = process.stdout.readline()
        assert line.startswith(f"http://127.0.0.1:{port} ")
        assert f"ssh -L {port}:127.0.0.1:{port}" in line
        with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=20) as answer:
            assert answer.status == 200
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=30) == ("", "")
        assert process.returncode == 0
    finally:
        process.kill()
