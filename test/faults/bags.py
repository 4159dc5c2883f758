"""Streams as bags on disk: what a fault makes of a file needs one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from recordings import write_mcap
from rosbags.rosbag2 import StoragePlugin, Writer
from streams import Item, Stream
from tiny_bag import TYPES, header

from vli_common.types import ImuSample

IMAGES, IMU = "/camera/image_raw/compressed", "/imu"


def write_bag(path: Path, stream: Stream, storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
    """Write compressed images and IMU samples in the order of the stream; return the rosbag2 directory."""
    first_ns = stream[0].stamp_ns
    with Writer(path, version=9, storage_plugin=storage) as writer:
        topics = {IMAGES: "sensor_msgs/msg/CompressedImage", IMU: "sensor_msgs/msg/Imu"}
        connections = {topic: writer.add_connection(topic, kind, typestore=TYPES) for topic, kind in topics.items()}
        for index, item in enumerate(stream):
            topic = IMU if isinstance(item, ImuSample) else IMAGES
            # The clock of the recorder goes on whatever the sensors' do.
            log_ns = first_ns + index * 4_000_000
            writer.write(connections[topic], log_ns, TYPES.serialize_cdr(_message(item), topics[topic]))
    return path


def write_chunked(path: Path, stream: Stream) -> Path:
    """Write a bare mcap as recorders do: in compressed chunks with a checksum each."""
    first_ns = stream[0].stamp_ns
    messages = (
        (first_ns + 4_000_000 * n, IMU if isinstance(i, ImuSample) else IMAGES, _message(i)) for n, i in enumerate(stream)
    )
    return write_mcap(path, messages, chunk_size=200_000)


def _message(item: Item) -> Any:
    if isinstance(item, ImuSample):
        vector, nothing = TYPES.types["geometry_msgs/msg/Vector3"], np.zeros(9)
        unknown = TYPES.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        gyro, accel = (vector(*map(float, values)) for values in (item.gyro, item.accel))
        return TYPES.types["sensor_msgs/msg/Imu"](header(item.stamp_ns), unknown, nothing, gyro, nothing, accel, nothing)
    data = np.frombuffer(item.data, np.uint8)
    return TYPES.types["sensor_msgs/msg/CompressedImage"](header(item.stamp_ns), item.encoding, data)
