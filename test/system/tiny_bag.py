"""Small bags with all that a scan needs, or with one thing wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from vli_driver.bag import BagTopics

TYPES = get_typestore(Stores.ROS2_JAZZY)
NS = 1_000_000_000
START_NS = 1_700_000_000 * NS

CALIBRATION: dict[str, Any] = {
    "cam0": {
        "camera_model": "pinhole",
        "intrinsics": [120.0, 120.0, 79.5, 59.5],
        "distortion_model": "radtan",
        "distortion_coeffs": [0.0, 0.0, 0.0, 0.0],
        "resolution": [160, 120],
        "rate_hz": 60.0,
        "T_cam_imu": np.eye(4).tolist(),
        "timeshift_cam_imu": 0.0,
    },
    "imu0": {
        "update_rate": 200.0,
        "accelerometer_noise_density": 2.0e-3,
        "accelerometer_random_walk": 3.0e-4,
        "gyroscope_noise_density": 2.4e-4,
        "gyroscope_random_walk": 2.0e-5,
    },
    "laser0": {"plane": [0.0, 0.8, -0.6, 0.02], "range_m": [0.02, 0.15]},
}


def write_calibration(path: Path, change: Callable[[dict[str, Any]], None] = lambda document: None) -> Path:
    """Write a valid calibration for the bags of this module, after ``change`` had its way with it."""
    document = yaml.safe_load(yaml.safe_dump(CALIBRATION))
    change(document)
    path.write_text(yaml.safe_dump(document))
    return path


def unchanged(stamp_ns: int) -> int:
    """Return the stamp as it is."""
    return stamp_ns


@dataclass
class TinyBag:
    """Two seconds of noise images, long and short, and of an IMU at rest.

    Args:
        image_topics: a stream each.
        imu_topics: a stream each.
        image_stamp, imu_stamp: bag time in ns → header stamp in ns.
        accel: m/s².
        tilt_rate: rad/s, amplitude of a swing to and fro.
        gyro_unit: factor on the angular rate.
        size: width, height.
        seconds: length.
        broken_images: share of the images, evenly spread, that are no images.
        broken_first: how many at the beginning are none.
        others: topic → text of one String message.
    """

    image_topics: tuple[str, ...] = ("/camera/image_raw/compressed",)
    imu_topics: tuple[str, ...] = ("/imu",)
    image_stamp: Callable[[int], int] = unchanged
    imu_stamp: Callable[[int], int] = unchanged
    accel: tuple[float, float, float] = (0.0, 0.0, 9.81)
    tilt_rate: float = 0.0
    gyro_unit: float = 1.0
    size: tuple[int, int] = (160, 120)
    seconds: float = 2.0
    broken_images: float = 0.0
    broken_first: int = 0
    others: dict[str, str] = field(default_factory=dict)

    @staticmethod
    def topics_without_imu() -> BagTopics:
        """Return what a reader asks of a bag that need not have an IMU."""
        return BagTopics(imu_required=False)

    def messages(self) -> list[tuple[str, int, Any]]:
        """Return topic, log time in ns and message of all that :meth:`write` writes, in log order."""
        return sorted([*self._images(), *self._imu(), *self._strings()], key=lambda message: message[1])

    def write(self, path: Path) -> Path:
        """Write a rosbag2 directory with one mcap file; return it."""
        messages = self.messages()
        with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connections: dict[str, Any] = {}
            for topic, log_ns, message in messages:
                kind = message.__msgtype__
                connection = connections.setdefault(topic, None) or writer.add_connection(topic, kind, typestore=TYPES)
                connections[topic] = connection
                writer.write(connection, log_ns, TYPES.serialize_cdr(message, kind))
        return path

    def _images(self) -> list[tuple[str, int, Any]]:
        kind = TYPES.types["sensor_msgs/msg/CompressedImage"]
        rng = np.random.default_rng(0)
        width, height = self.size
        texture = cv2.GaussianBlur(rng.integers(0, 255, (height, width), dtype=np.uint8), (0, 0), 2)
        jpegs = [np.asarray(cv2.imencode(".jpg", (texture * gain).astype(np.uint8))[1]).ravel() for gain in (0.9, 0.05)]
        stamps = START_NS + np.arange(round(60 * self.seconds)) * NS // 60
        every = round(1 / self.broken_images) if self.broken_images else len(stamps) + 1
        broken = [index < self.broken_first or not (index + 1) % every for index in range(len(stamps))]
        data = [np.zeros(9, np.uint8) if broken[index] else jpegs[index % 2] for index in range(len(stamps))]
        return [
            (topic, int(stamp), kind(header(self.image_stamp(int(stamp))), "jpeg", bytes_))
            for topic in self.image_topics
            for stamp, bytes_ in zip(stamps, data, strict=True)
        ]

    def _imu(self) -> list[tuple[str, int, Any]]:
        kind, vector = TYPES.types["sensor_msgs/msg/Imu"], TYPES.types["geometry_msgs/msg/Vector3"]
        unknown = TYPES.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        nothing = np.zeros(9)
        messages = []
        for index in range(round(200 * self.seconds)):
            t = index / 200
            tilt = self.tilt_rate * (1 - np.cos(t))
            y, z = np.array([[np.cos(tilt), np.sin(tilt)], [-np.sin(tilt), np.cos(tilt)]]) @ self.accel[1:]
            stamp = START_NS + index * NS // 200
            gyro = vector(self.gyro_unit * self.tilt_rate * float(np.sin(t)), 0.0, 0.0)
            accel = vector(self.accel[0], float(y), float(z))
            message = kind(header(self.imu_stamp(stamp)), unknown, nothing, gyro, nothing, accel, nothing)
            messages += [(topic, stamp, message) for topic in self.imu_topics]
        return messages

    def _strings(self) -> list[tuple[str, int, Any]]:
        kind = TYPES.types["std_msgs/msg/String"]
        return [(topic, START_NS, kind(text)) for topic, text in self.others.items()]


def header(stamp_ns: int) -> Any:
    """Return a header with this stamp."""
    time = TYPES.types["builtin_interfaces/msg/Time"](stamp_ns // NS, stamp_ns % NS)
    return TYPES.types["std_msgs/msg/Header"](time, "camera_optical_frame")
