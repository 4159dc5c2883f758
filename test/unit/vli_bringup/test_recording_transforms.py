"""Recordings hold transforms whether or not ROS has the package for them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation
from std_msgs.msg import String
from tiny_bag import CALIBRATION

from vli_bringup.recording.bag_writer import BagWriter
from vli_bringup.recording.topic import RawMessage, RecordedTopic
from vli_bringup.recording.transforms import TransformMaker
from vli_common.calibration import to_yaml
from vli_common.geometry import inverse, pose
from vli_common.messages import odometry_to_message, pose_to_message
from vli_common.types import NANOSECONDS, PoseEstimate

STAMP = 1_700_000_000 * NANOSECONDS + 5
T_MAP_IMU = pose(Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix(), np.array([0.1, 0.2, 0.3]))
T_MAP_ODOM = pose(Rotation.from_rotvec([0.0, 0.0, 0.4]).as_matrix(), np.array([0.01, 0.0, 0.0]))
T_CAM_IMU = pose(Rotation.from_rotvec([1.5, 0.0, 0.0]).as_matrix(), np.array([0.0, 0.02, 0.0]))


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """Return a bag of one odometry, its pose, a calibration, and a pose without odometry."""
    writer = BagWriter(tmp_path, "scan")
    maker = TransformMaker(writer.write)
    estimate = PoseEstimate(STAMP, T_MAP_IMU, T_MAP_ODOM, np.zeros(3), np.zeros(3), np.eye(6))
    alone = PoseEstimate(STAMP + 1, T_MAP_IMU, T_MAP_ODOM, np.zeros(3), np.zeros(3), np.eye(6))
    document = {**CALIBRATION, "cam0": {**CALIBRATION["cam0"], "T_cam_imu": T_CAM_IMU.tolist()}}
    messages = [
        ("calibration", "std_msgs/msg/String", String(data=to_yaml(document))),
        ("calibration", "std_msgs/msg/String", String(data="nonsense")),
        ("odometry", "nav_msgs/msg/Odometry", odometry_to_message(estimate)),
        ("pose", "geometry_msgs/msg/PoseStamped", pose_to_message(estimate)),
        ("pose", "geometry_msgs/msg/PoseStamped", pose_to_message(alone)),
    ]
    topics = {name: RecordedTopic(f"/vli/{name}", kind, 10) for name, kind, _ in messages}
    for number, (name, _, message) in enumerate(messages):
        maker.put(topics[name], RawMessage(serialize_message(message), STAMP + number, STAMP, number))
    writer.close()
    return tmp_path


def transforms(path: Path, topic: str) -> dict[tuple[str, str], tuple[int, np.ndarray]]:
    """Return (parent, child) → stamp and T_parent_child, as another program reads them."""
    found = {}
    with AnyReader([path]) as reader:
        connections = [item for item in reader.connections if item.topic == topic]
        for connection, _, data in reader.messages(connections):
            for item in reader.deserialize(data, connection.msgtype).transforms:
                t, q = item.transform.translation, item.transform.rotation
                T = pose(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), np.array([t.x, t.y, t.z]))
                stamp = item.header.stamp.sec * NANOSECONDS + item.header.stamp.nanosec
                found[item.header.frame_id, item.child_frame_id] = (stamp, T)
    return found


def test_pose_and_odometry_of_a_frame_become_two_transforms_of_its_stamp(recorded: Path) -> None:
    found = transforms(recorded, "/tf")
    assert {stamp for stamp, _ in found.values()} == {STAMP}
    np.testing.assert_allclose(found["map", "odom"][1], T_MAP_ODOM, atol=1e-12)
    np.testing.assert_allclose(found["odom", "imu_link"][1], inverse(T_MAP_ODOM) @ T_MAP_IMU, atol=1e-12)


def test_the_calibration_becomes_a_static_transform_that_late_players_offer_to_late_readers(recorded: Path) -> None:
    ((frames, (_, T)),) = transforms(recorded, "/tf_static").items()
    assert frames == ("imu_link", "camera_optical_frame")
    np.testing.assert_allclose(T, inverse(T_CAM_IMU), atol=1e-12)
    with AnyReader([recorded]) as reader:
        (connection,) = [item for item in reader.connections if item.topic == "/tf_static"]
        assert connection.ext.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL"
