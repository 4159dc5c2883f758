"""All topics of a recording, heard by one node."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Sequence
from typing import NamedTuple

import rclpy
from rclpy.executors import SingleThreadedExecutor

from vli_bringup.recording.subscription import Put, RawSubscription
from vli_bringup.recording.topic import RecordedTopic
from vli_common.node.transport import set_transport_profile
from vli_common.topics import EXPOSURE, IMAGE_RAW, IMAGE_RAW_COMPRESSED, IMU, NAMESPACE, TOPICS, Topic
from vli_driver.config import DriverConfig

CAMERA_INFO = Topic("/camera/camera_info", "sensor_msgs/msg/CameraInfo", 10, ("driver_node",), ("anyone",))
_COMPRESSED = "/compressed"
_ADAPT_S = 0.25


class Heard(NamedTuple):
    """A topic, and the name to find it under."""

    topic: Topic
    name: str


def scanner_topics(config: DriverConfig) -> list[Heard]:
    """Return what comes from the scanner itself; a name that ends in ``/compressed`` means that stream alone."""
    image = config.image_topic.removesuffix(_COMPRESSED)
    raw = [] if image != config.image_topic else [Heard(IMAGE_RAW, image)]
    return [
        *raw,
        Heard(IMAGE_RAW_COMPRESSED, image + _COMPRESSED),
        Heard(CAMERA_INFO, config.camera_info_topic),
        Heard(EXPOSURE, config.exposure_topic),
        Heard(IMU, config.imu_topic),
    ]


def graph_topics() -> list[Heard]:
    """Return what the nodes publish, as far as the interface packages are installed."""
    scanner = (IMAGE_RAW, IMAGE_RAW_COMPRESSED, EXPOSURE, IMU)
    return [
        Heard(topic, topic.name)
        for topic in TOPICS
        if topic not in scanner and importlib.util.find_spec(topic.type.partition("/")[0]) is not None
    ]


class RecordingListener:
    """Subscribes to topics and hands on what comes; use as a context manager.

    Args:
        topics: to hear.
        put: gets every message.
    """

    def __init__(self, topics: Sequence[Heard], put: Put) -> None:
        self._topics, self._put = topics, put
        self._subscriptions: dict[Heard, RawSubscription] = {}
        self._adapted_s = 0.0

    def __enter__(self) -> RecordingListener:
        """Join the graph."""
        set_transport_profile()
        rclpy.init(signal_handler_options=rclpy.SignalHandlerOptions.NO)
        self._node = rclpy.create_node("record", namespace=NAMESPACE)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._subscriptions = {item: RawSubscription(self._node, item.topic, item.name, self._put) for item in self._topics}
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the graph."""
        self._executor.shutdown(timeout_sec=0)
        self._node.destroy_node()
        rclpy.try_shutdown()

    @property
    def recorded(self) -> list[RecordedTopic]:
        """What is known of every topic."""
        return [item.recorded for item in self._subscriptions.values()]

    def missing(self) -> list[str]:
        """Return what a scan needs and nobody publishes: images or IMU."""
        publishers = {topic: item.publishers for topic, item in self._subscriptions.items()}
        images = [item for item in publishers if item.topic in (IMAGE_RAW, IMAGE_RAW_COMPRESSED)]
        silent = [] if any(publishers[item] for item in images) else [images[0]]
        silent += [item for item, count in publishers.items() if item.topic is IMU and not count]
        return [item.name for item in silent]

    def spin(self, seconds: float) -> list[str]:
        """Take what comes for some seconds; return what is to be told of topics."""
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            self._executor.spin_once(left_s)
        if time.monotonic() < self._adapted_s + _ADAPT_S:
            return []
        self._adapted_s = time.monotonic()
        told = [text for item in self._subscriptions.values() for text in item.adapt()]
        return told + self._drop_double()

    def close(self) -> None:
        """Take what has come until now, and hear nothing more."""
        for item in self._subscriptions.values():
            item.close()

    def _drop_double(self) -> list[str]:
        """Stop to hear compressed images where the raw ones come as well: they are the same, and compressing costs the camera."""
        by_topic = {item.topic: subscription for item, subscription in self._subscriptions.items()}
        raw, compressed = by_topic.get(IMAGE_RAW), by_topic.get(IMAGE_RAW_COMPRESSED)
        if raw is None or compressed is None or not (raw.recorded.messages and compressed.recorded.messages):
            return []
        if compressed.is_closed:
            return []
        compressed.close()
        return [f"'{compressed.recorded.name}' is recorded no further: '{raw.recorded.name}' has the same images"]
