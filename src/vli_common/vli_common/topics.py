"""The one table of topics: name, type, quality of service, who sends, who listens, and the fields of every cloud.

Names are relative to the namespace of the node (``/vli`` unless remapped); those with a leading slash are not. A stamp inside a
cloud is two uint32 ``sec`` and ``nanosec``; every cloud carries ``session``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import numpy as np

NAMESPACE = "vli"
CAMERA_FRAME = "camera_optical_frame"
IMU_FRAME = "imu_link"
MAP_FRAME = "map"
ODOM_FRAME = "odom"

_XYZ: list[tuple[str, str]] = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
_STAMP: list[tuple[str, str]] = [("sec", "<u4"), ("nanosec", "<u4")]
_SESSION: list[tuple[str, str]] = [("session", "<u4")]


def _doubles(*names: str) -> list[tuple[str, str]]:
    return [(name, "<f8") for name in names]


LASER_POINTS_FIELDS = np.dtype([*_XYZ, ("u", "<f4"), ("v", "<f4"), ("intensity", "<f4"), ("sigma", "<f4"), *_SESSION])
TRACKS_FIELDS = np.dtype(
    [("id", "<u4"), *_doubles("u", "v", "x", "y", "vx", "vy", "sigma", "stripe_px"), ("flags", "u1"), *_SESSION]
)
WINDOW_FIELDS = np.dtype(
    [
        *_STAMP,
        ("kind", "u1"),
        ("state", "u1"),
        *_doubles("px", "py", "pz", "qx", "qy", "qz", "qw"),
        ("placement", "<u4"),
        *_SESSION,
    ]
)
MAP_CONSTRAINTS_FIELDS = np.dtype(
    [*_STAMP, *_doubles("px", "py", "pz", "gx", "gy", "gz", "nx", "ny", "nz", "sigma", "weight"), *_SESSION]
)
CLOUD_FIELDS = np.dtype([*_XYZ, ("rgb", "<f4"), *_SESSION])
MAP_FIELDS = np.dtype(
    [*_XYZ, ("normal_x", "<f4"), ("normal_y", "<f4"), ("normal_z", "<f4"), ("rgb", "<f4"), ("weight", "<f4"), *_SESSION]
)


def preintegration_fields(size: int) -> np.dtype[np.void]:
    """Return the layout of the one row of ``preintegration``, whose ``data`` has ``size`` bytes."""
    return np.dtype(
        [("from_sec", "<u4"), ("from_nanosec", "<u4"), ("inflate", "<f8"), ("crc32", "<u4"), *_SESSION, ("data", "u1", (size,))]
    )


class WindowState(IntFlag):
    """Values of ``state`` in a row of ``window``."""

    IN = 0
    FINAL = 1
    """Has left the window: sent for the last time."""
    REDUNDANT = 2
    """Taken at rest, adds nothing to the map."""
    UNLOCATED = 4
    """Where it is in the map is a guess; of all rows or none."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic.

    Args:
        name: relative to the node's namespace, or absolute.
        type: ROS interface name.
        depth: of the queue, RELIABLE and KEEP_LAST.
        transient_local: True where a late subscriber gets the last message.
        sources, targets: executables; ``anyone`` is the world outside.
        fields: layout of a cloud, or None.
        kept: what a publisher keeps for a reader that stands still, where that is more than the depth.
    """

    name: str
    type: str
    depth: int
    sources: tuple[str, ...]
    targets: tuple[str, ...]
    transient_local: bool = False
    fields: np.dtype[np.void] | None = None
    kept: int = 0


_NODES = ("driver_node", "demux_node", "frontend_node", "backend_node", "mapping_node")
_CLOUD = "sensor_msgs/msg/PointCloud2"

CALIBRATION = Topic("calibration", "std_msgs/msg/String", 1, ("driver_node",), _NODES[1:], transient_local=True)
SESSION = Topic("session", "std_msgs/msg/Header", 1, _NODES, _NODES, transient_local=True)
IMAGE_LONG = Topic("image_long", "sensor_msgs/msg/Image", 5, ("demux_node",), ("frontend_node", "mapping_node"), kept=45)
IMAGE_SHORT = Topic("image_short", "sensor_msgs/msg/Image", 2, ("demux_node",), ("anyone",))
LASER_POINTS = Topic(
    "laser_points",
    _CLOUD,
    10,
    ("demux_node",),
    ("frontend_node", "backend_node", "mapping_node"),
    fields=LASER_POINTS_FIELDS,
    kept=60,
)
TRACKS = Topic("tracks", _CLOUD, 10, ("frontend_node",), ("backend_node",), fields=TRACKS_FIELDS, kept=60)
PREINTEGRATION = Topic(
    "preintegration", _CLOUD, 10, ("frontend_node",), ("backend_node",), fields=preintegration_fields(0), kept=60
)
BIAS = Topic("bias", "geometry_msgs/msg/TwistStamped", 1, ("backend_node",), ("frontend_node",), transient_local=True)
ODOMETRY = Topic("odometry", "nav_msgs/msg/Odometry", 10, ("backend_node",), ("frontend_node", "anyone"))
POSE = Topic("pose", "geometry_msgs/msg/PoseStamped", 10, ("backend_node",), ("anyone",))
PATH = Topic("path", "nav_msgs/msg/Path", 10, ("backend_node",), ("anyone",))
TF = Topic("/tf", "tf2_msgs/msg/TFMessage", 10, ("backend_node",), ("anyone",))
TF_STATIC = Topic("/tf_static", "tf2_msgs/msg/TFMessage", 10, ("backend_node",), ("anyone",), transient_local=True)
WINDOW = Topic("window", _CLOUD, 5, ("backend_node",), ("mapping_node",), fields=WINDOW_FIELDS, kept=30)
MAP_CONSTRAINTS = Topic("map_constraints", _CLOUD, 2, ("mapping_node",), ("backend_node",), fields=MAP_CONSTRAINTS_FIELDS)
RELOCALISATION = Topic("relocalisation", "geometry_msgs/msg/PoseWithCovarianceStamped", 1, ("mapping_node",), ("backend_node",))
CLOUD = Topic("cloud", _CLOUD, 5, ("mapping_node",), ("anyone",), fields=CLOUD_FIELDS)
MAP = Topic("map", _CLOUD, 1, ("mapping_node",), ("anyone",), transient_local=True, fields=MAP_FIELDS)
MAP_UPDATE = Topic("map_update", _CLOUD, 5, ("mapping_node",), ("anyone",), fields=MAP_FIELDS)
STATUS = Topic("status", "diagnostic_msgs/msg/DiagnosticArray", 10, _NODES, ("anyone",))
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", 10, _NODES, ("anyone",))

IMAGE_RAW = Topic("/camera/image_raw", "sensor_msgs/msg/Image", 10, ("driver_node",), ("demux_node",), kept=60)
IMAGE_RAW_COMPRESSED = Topic(
    "/camera/image_raw/compressed", "sensor_msgs/msg/CompressedImage", 30, ("driver_node",), ("demux_node",), kept=120
)
EXPOSURE = Topic("/camera/exposure", "diagnostic_msgs/msg/DiagnosticArray", 30, ("driver_node",), ("demux_node",), kept=120)
IMU = Topic("/imu", "sensor_msgs/msg/Imu", 200, ("driver_node",), ("frontend_node",), kept=2000)

TOPICS: tuple[Topic, ...] = (
    CALIBRATION, SESSION, IMAGE_LONG, IMAGE_SHORT, LASER_POINTS, TRACKS, PREINTEGRATION, BIAS, ODOMETRY, POSE, PATH, TF,
    TF_STATIC, WINDOW, MAP_CONSTRAINTS, RELOCALISATION, CLOUD, MAP, MAP_UPDATE, STATUS, DIAGNOSTICS,
    IMAGE_RAW, IMAGE_RAW_COMPRESSED, EXPOSURE, IMU,
)  # fmt: skip
"""Every topic; the last four are the scanner's own, whose names are parameters."""
