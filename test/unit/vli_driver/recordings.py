"""Small bags with known content."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
T = STORE.types
IMAGE_NS, IMU_NS, START_NS = 16_666_667, 5_000_000, 100_000_000_000
IMAGES, IMU_SAMPLES = 60, 200
PIXELS = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)


def stamp(ns: int) -> Any:
    return T["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)


def header(ns: int) -> Any:
    # A frame_id of odd length, so that the fields after it need padding.
    return T["std_msgs/msg/Header"](stamp=stamp(ns), frame_id="camera")


def image(ns: int, encoding: str = "mono8", pixels: np.ndarray = PIXELS, step: int = 0) -> Any:
    step = step or pixels.nbytes // len(pixels)
    data = np.zeros((len(pixels), step), np.uint8)
    rows = pixels.reshape(len(pixels), -1).view(np.uint8)
    data[:, : rows.shape[1]] = rows
    return T["sensor_msgs/msg/Image"](header(ns), pixels.shape[0], pixels.shape[1], encoding, 0, step, data.ravel())


def compressed(ns: int, form: str = "jpeg", suffix: str = ".jpg", pixels: np.ndarray = PIXELS) -> Any:
    return T["sensor_msgs/msg/CompressedImage"](header(ns), form, cv2.imencode(suffix, pixels)[1])


def imu(ns: int) -> Any:
    vector, zeros = T["geometry_msgs/msg/Vector3"], np.zeros(9)
    orientation = T["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    return T["sensor_msgs/msg/Imu"](
        header(ns), orientation, zeros, vector(0.1, 0.2, ns * 1e-9), zeros, vector(1.0, 2.0, 9.8), zeros
    )


def exposure(ns: int, laser: str) -> Any:
    pair = T["diagnostic_msgs/msg/KeyValue"]
    values = [pair("exposure_s", "0.005" if laser == "off" else "0.0003"), pair("laser", laser)]
    status = T["diagnostic_msgs/msg/DiagnosticStatus"](0, "camera", "", "", values)
    return T["diagnostic_msgs/msg/DiagnosticArray"](header(ns), [status])


def standard(image_topic: str = "/camera/image_raw", imu_topic: str | None = "/imu") -> Iterator[tuple[int, str, Any]]:
    """Yield one second of images and IMU as (log time, topic, message), in log order."""
    messages = [(START_NS + k * IMAGE_NS, image_topic, image(START_NS + k * IMAGE_NS)) for k in range(IMAGES)]
    if imu_topic:
        messages += [(START_NS + k * IMU_NS, imu_topic, imu(START_NS + k * IMU_NS)) for k in range(IMU_SAMPLES)]
    yield from sorted(messages, key=lambda item: item[0])


def write(
    path: Path,
    messages: Any,
    plugin: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """Write a rosbag2 directory; returns its only data file."""
    writer = Writer(path, version=9, storage_plugin=plugin)
    if compression is not CompressionMode.NONE:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for log_ns, topic, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=STORE)
            writer.write(connections[topic], log_ns, STORE.serialize_cdr(message, message.__msgtype__))
    return next(item for item in path.iterdir() if item.suffix in (".mcap", ".db3"))


def write_mcap(path: Path, messages: Any, **options: Any) -> Path:
    """Write a bare mcap with the reference writer (chunk size, compression, no chunks at all: its options)."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, **options)
        writer.start("ros2", "test")
        channels: dict[str, int] = {}
        for log_ns, topic, message in messages:
            if topic not in channels:
                schema = writer.register_schema(message.__msgtype__, "ros2msg", b"")
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            data = bytes(STORE.serialize_cdr(message, message.__msgtype__))
            writer.add_message(channels[topic], log_ns, data, log_ns)
        writer.finish()
    return path
