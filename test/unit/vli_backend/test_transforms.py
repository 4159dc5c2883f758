"""The transforms of REP 105, which the back-end node publishes where ROS has the package for them (pip's has not)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy

from vli_backend.nodes import backend_node
from vli_backend.nodes.backend_node import BackEndNode
from vli_common.calibration import load_calibration
from vli_common.geometry import inverse, pose
from vli_common.messages import transform_from_message
from vli_common.topics import TF, TF_STATIC, Topic
from vli_common.types import PoseEstimate


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, list[Any]]]:
    """Return what the node sends by topic; the message of ``tf2_msgs`` is stood in for."""
    found: dict[str, list[Any]] = {}

    def send(_: BackEndNode, topic: Topic, message: Any) -> None:
        found[topic.name].append(message)

    monkeypatch.setattr(backend_node, "TFMessage", lambda transforms: SimpleNamespace(transforms=transforms))
    monkeypatch.setattr(backend_node, "warm_up", lambda: None)
    monkeypatch.setattr(BackEndNode, "advertise", lambda _, topic, name=None: found.setdefault(topic.name, []))
    monkeypatch.setattr(BackEndNode, "send", send)
    rclpy.init()
    yield found
    rclpy.try_shutdown()


def test_map_odom_imu_and_camera_are_one_tree(sent: dict[str, list[Any]], repository: Path) -> None:
    calibration = load_calibration(repository / "bags/demo/calibration.yaml")
    T_map_imu, T_map_odom = pose(np.eye(3), np.array([0.1, 0.2, 0.3])), pose(np.eye(3), np.array([0.01, 0.0, 0.0]))
    node = BackEndNode()
    node.create_stage(calibration)
    node._send_pose(PoseEstimate(5, T_map_imu, T_map_odom, np.zeros(3), np.zeros(3), np.eye(6)))
    node.destroy_node()
    (fixed,), (moving,) = sent[TF_STATIC.name], sent[TF.name]
    ((_, parent, child, T_imu_camera),) = map(transform_from_message, fixed.transforms)
    assert (parent, child) == ("imu_link", "camera_optical_frame")
    np.testing.assert_allclose(T_imu_camera, inverse(calibration.T_cam_imu), atol=1e-9)
    first, second = map(transform_from_message, moving.transforms)
    assert [item[:3] for item in (first, second)] == [(5, "map", "odom"), (5, "odom", "imu_link")]
    np.testing.assert_allclose(first[3], T_map_odom)
    np.testing.assert_allclose(first[3] @ second[3], T_map_imu)


def test_without_the_package_no_transform_is_advertised(sent: dict[str, list[Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backend_node, "TFMessage", None)
    BackEndNode().destroy_node()
    assert "odometry" in sent
    assert TF.name not in sent
