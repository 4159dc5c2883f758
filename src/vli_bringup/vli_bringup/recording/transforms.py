"""``/tf`` and ``/tf_static`` of a recording where ROS has no ``tf2_msgs``: made of odometry, pose and calibration."""

from __future__ import annotations

import importlib.util
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rosbags.typesys import Stores, get_typestore

from vli_bringup.recording.subscription import Put
from vli_bringup.recording.topic import RawMessage, RecordedTopic
from vli_common.arrays import FloatArray
from vli_common.calibration import parse_calibration
from vli_common.errors import CalibrationError, MessageError
from vli_common.geometry import inverse, quaternion_from_rotation
from vli_common.messages import odometry_from_message, pose_from_message
from vli_common.node.transport import message_type
from vli_common.topics import (
    CALIBRATION,
    CAMERA_FRAME,
    IMU_FRAME,
    MAP_FRAME,
    NAMESPACE,
    ODOM_FRAME,
    ODOMETRY,
    POSE,
    TF,
    TF_STATIC,
    Topic,
)
from vli_common.types import NANOSECONDS

_WAITING = 100
"""Poses that wait for their odometry, or the other way round."""


def are_published() -> bool:
    """Return True where the nodes can publish transforms themselves."""
    return importlib.util.find_spec("tf2_msgs") is not None


class TransformMaker:
    """Hands on every message, and with odometry, pose and calibration the transforms that they tell.

    Args:
        put: gets the messages.
    """

    def __init__(self, put: Put) -> None:
        self.recorded = [_recorded(TF), _recorded(TF_STATIC)]
        self._put = put
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._waiting: dict[int, dict[str, FloatArray]] = {}
        self._readers = {f"/{NAMESPACE}/{topic.name}": topic for topic in (ODOMETRY, POSE, CALIBRATION)}

    def put(self, topic: RecordedTopic, message: RawMessage) -> None:
        """Take a message."""
        self._put(topic, message)
        known = self._readers.get(topic.name)
        if known is None:
            return
        try:
            read = deserialize_message(message.data, message_type(known))
            if known is CALIBRATION:
                self._put_static(parse_calibration(read.data, None).T_cam_imu, message)
            elif known is POSE:
                self._join(POSE, *pose_from_message(read), message)
            else:
                estimate = odometry_from_message(read)
                self._join(ODOMETRY, estimate.stamp_ns, estimate.T_map_imu, message)
        except (MessageError, CalibrationError):
            return

    def _join(self, topic: Topic, stamp_ns: int, T: FloatArray, message: RawMessage) -> None:
        """Put ``map`` → ``odom`` → ``imu_link`` once pose and odometry of a frame are there."""
        both = self._waiting.setdefault(stamp_ns, {})
        both[topic.name] = T
        if len(both) == 2:
            del self._waiting[stamp_ns]
            T_odom_imu = both[ODOMETRY.name]
            transforms = [
                self._transform(stamp_ns, MAP_FRAME, ODOM_FRAME, both[POSE.name] @ inverse(T_odom_imu)),
                self._transform(stamp_ns, ODOM_FRAME, IMU_FRAME, T_odom_imu),
            ]
            self._write(self.recorded[0], transforms, message)
        elif len(self._waiting) > _WAITING:
            del self._waiting[next(iter(self._waiting))]

    def _put_static(self, T_cam_imu: FloatArray | None, message: RawMessage) -> None:
        if T_cam_imu is not None:
            self._write(self.recorded[1], [self._transform(0, IMU_FRAME, CAMERA_FRAME, inverse(T_cam_imu))], message)

    def _transform(self, stamp_ns: int, parent: str, child: str, T_parent_child: FloatArray) -> Any:
        make = self._store.types
        stamp = make["builtin_interfaces/msg/Time"](sec=stamp_ns // NANOSECONDS, nanosec=stamp_ns % NANOSECONDS)
        translation = make["geometry_msgs/msg/Vector3"](*T_parent_child[:3, 3].tolist())
        rotation = make["geometry_msgs/msg/Quaternion"](*quaternion_from_rotation(T_parent_child[:3, :3]).tolist())
        return make["geometry_msgs/msg/TransformStamped"](
            header=make["std_msgs/msg/Header"](stamp=stamp, frame_id=parent),
            child_frame_id=child,
            transform=make["geometry_msgs/msg/Transform"](translation=translation, rotation=rotation),
        )

    def _write(self, topic: RecordedTopic, transforms: list[Any], message: RawMessage) -> None:
        data = bytes(self._store.serialize_cdr(self._store.types[topic.type](transforms=transforms), topic.type))
        self._put(topic, RawMessage(data, message.log_ns, message.publish_ns, message.sequence))


def _recorded(topic: Topic) -> RecordedTopic:
    durability = DurabilityPolicy.TRANSIENT_LOCAL if topic.transient_local else DurabilityPolicy.VOLATILE
    profile = QoSProfile(depth=topic.depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
    return RecordedTopic(topic.name, topic.type, topic.depth, [profile])
