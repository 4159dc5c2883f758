"""Poses ⇄ messages: odometry, pose, path, transforms, relocalisation."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Vector3,
)
from nav_msgs.msg import Odometry, Path

from vli_common import cdr, geometry
from vli_common.arrays import FloatArray
from vli_common.errors import MessageError
from vli_common.messages.basics import from_time, header
from vli_common.messages.limits import LARGEST_VARIANCE, checked
from vli_common.topics import IMU_FRAME, MAP_FRAME, ODOM_FRAME
from vli_common.types import PoseEstimate, Relocalisation

_UNIT_TOLERANCE = 1e-3


def odometry_to_message(pose: PoseEstimate) -> Odometry:
    """Return ``odometry``: ``odom`` → ``imu_link``; twist in ``imu_link``; the covariance turned to the axes of ``odom``."""
    rotation = pose.T_map_odom[:3, :3].T
    turn = np.kron(np.eye(2), rotation)
    message = Odometry(header=header(pose.stamp_ns, ODOM_FRAME), child_frame_id=IMU_FRAME)
    message.pose.pose = _to_pose(geometry.inverse(pose.T_map_odom) @ pose.T_map_imu)
    message.pose.covariance = (turn @ pose.covariance @ turn.T).ravel()
    message.twist.twist.linear = to_vector(pose.T_map_imu[:3, :3].T @ pose.velocity)
    message.twist.twist.angular = to_vector(pose.angular_velocity)
    return message


def odometry_from_message(message: Odometry, T_map_odom: FloatArray | None = None) -> PoseEstimate:
    """Return the pose of ``odometry``; without ``T_map_odom`` its ``map`` is ``odom``.

    Raises:
        MessageError: not finite, or no unit quaternion.
    """
    T_map_odom = np.eye(4) if T_map_odom is None else T_map_odom
    turn = np.kron(np.eye(2), T_map_odom[:3, :3])
    T_map_imu = T_map_odom @ _from_pose(message.pose.pose)
    return PoseEstimate(
        stamp_ns=from_time(message.header.stamp),
        T_map_imu=T_map_imu,
        T_map_odom=T_map_odom,
        velocity=T_map_imu[:3, :3] @ from_vector(message.twist.twist.linear),
        angular_velocity=from_vector(message.twist.twist.angular),
        covariance=turn @ _covariance(message.pose.covariance) @ turn.T,
    )


def pose_to_message(pose: PoseEstimate) -> PoseStamped:
    """Return ``pose``: ``imu_link`` in ``map``."""
    return PoseStamped(header=header(pose.stamp_ns, MAP_FRAME), pose=_to_pose(pose.T_map_imu))


def pose_from_message(message: PoseStamped) -> tuple[int, FloatArray]:
    """Return stamp and T_map_imu (4, 4) of ``pose``.

    Raises:
        MessageError: not finite, or no unit quaternion.
    """
    return from_time(message.header.stamp), _from_pose(message.pose)


def path_to_message(poses: list[PoseStamped]) -> Path:
    """Return ``path`` of the messages sent on ``pose``, the newest last."""
    stamp_ns = from_time(poses[-1].header.stamp) if poses else 0
    return Path(header=header(stamp_ns, MAP_FRAME), poses=poses)


def path_from_message(message: Path) -> list[tuple[int, FloatArray]]:
    """Return stamps and poses T_map_imu of ``path``."""
    return [pose_from_message(item) for item in message.poses]


def transform_to_message(stamp_ns: int, parent: str, child: str, T_parent_child: FloatArray) -> TransformStamped:
    """Return one transform of ``/tf`` or ``/tf_static``."""
    pose = _to_pose(T_parent_child)
    translation = Vector3(x=pose.position.x, y=pose.position.y, z=pose.position.z)
    return TransformStamped(
        header=header(stamp_ns, parent),
        child_frame_id=child,
        transform=Transform(translation=translation, rotation=pose.orientation),
    )


def pose_transforms(pose: PoseEstimate) -> list[TransformStamped]:
    """Return the transforms of one frame: ``map`` → ``odom`` → ``imu_link``."""
    T_odom_imu = geometry.inverse(pose.T_map_odom) @ pose.T_map_imu
    return [
        transform_to_message(pose.stamp_ns, MAP_FRAME, ODOM_FRAME, pose.T_map_odom),
        transform_to_message(pose.stamp_ns, ODOM_FRAME, IMU_FRAME, T_odom_imu),
    ]


def transform_from_message(message: TransformStamped) -> tuple[int, str, str, FloatArray]:
    """Return stamp, parent, child and T_parent_child.

    Raises:
        MessageError: not finite, or no unit quaternion.
    """
    position, rotation = message.transform.translation, message.transform.rotation
    T = _from_pose(Pose(position=Point(x=position.x, y=position.y, z=position.z), orientation=rotation))
    return from_time(message.header.stamp), message.header.frame_id, message.child_frame_id, T


def relocalisation_to_message(found: Relocalisation) -> PoseWithCovarianceStamped:
    """Return ``relocalisation``: the session's ``map`` so far in the map; the covariance has the position alone."""
    message = PoseWithCovarianceStamped(header=header(found.stamp_ns, MAP_FRAME))
    message.pose.pose = _to_pose(found.T_map_session)
    message.pose.covariance = np.diag([found.sigma_m**2] * 3 + [0.0] * 3).ravel()
    return message


def relocalisation_from_message(message: PoseWithCovarianceStamped, session: int = 0) -> Relocalisation:
    """Return where a session is in the map; the message does not say which session, the stamp tells those of others.

    Raises:
        MessageError: not finite, or no unit quaternion, or a negative variance.
    """
    variances = np.diag(_covariance(message.pose.covariance))[:3]
    if (variances < 0).any():
        raise MessageError(f"relocalisation has the variances '{variances.tolist()}', expected none below 0")
    stamp_ns, T_map_session = from_time(message.header.stamp), _from_pose(message.pose.pose)
    return Relocalisation(stamp_ns, T_map_session, float(np.sqrt(variances.max())), session)


def from_vector(vector: Vector3 | cdr.Vector) -> FloatArray:
    """Return (3,) of a vector.

    Raises:
        MessageError: not finite.
    """
    return checked(np.array([vector.x, vector.y, vector.z]), "vector")


def to_vector(values: FloatArray) -> Vector3:
    """Return the vector of (3,)."""
    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)


def rotations_from_quaternions(quaternions: FloatArray) -> FloatArray:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4) x y z w.

    Raises:
        MessageError: one is not of unit length.
    """
    if (np.abs(np.linalg.norm(quaternions, axis=-1) - 1) > _UNIT_TOLERANCE).any():
        raise MessageError("pose has a quaternion that is not unit")
    return geometry.rotation_from_quaternion(quaternions)


def _to_pose(T: FloatArray) -> Pose:
    x, y, z = T[:3, 3].tolist()
    qx, qy, qz, qw = geometry.quaternion_from_rotation(T[:3, :3]).tolist()
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def _from_pose(pose: Pose) -> FloatArray:
    p, q = pose.position, pose.orientation
    rotation = rotations_from_quaternions(checked(np.array([q.x, q.y, q.z, q.w]), "quaternion"))
    return geometry.pose(rotation, checked(np.array([p.x, p.y, p.z]), "position"))


def _covariance(values: FloatArray) -> FloatArray:
    return checked(np.array(values, dtype=np.float64), "covariance", LARGEST_VARIANCE).reshape(6, 6)
