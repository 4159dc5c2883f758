"""What a running sensor and running nodes send, for a few seconds."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from vli_bringup.diagnosis.findings import Finding, Level
from vli_common.errors import MessageError
from vli_common.messages import encoded_from_message, imu_from_message, status_from_message
from vli_common.node.transport import SHARED_MEMORY_PROFILE, local_profile, message_type, quality, set_transport_profile
from vli_common.status import Health, StageStatus
from vli_common.topics import IMAGE_RAW, IMAGE_RAW_COMPRESSED, IMU, NAMESPACE, STATUS, Topic
from vli_common.types import EncodedImage, ImuSample
from vli_driver.config import DriverConfig

_DEPTH = 500


@dataclass
class Heard:
    """What came: images and IMU samples by their stamps, and what is to be said of topics and nodes.

    ``has_camera`` and ``has_imu`` are False where nobody publishes, which is a finding already.
    """

    items: list[EncodedImage | ImuSample] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    statuses: dict[str, StageStatus] = field(default_factory=dict)
    has_camera: bool = True
    has_imu: bool = True


def listen(config: DriverConfig, seconds: float) -> Heard:
    """Collect for some seconds what camera, IMU and nodes send."""
    set_transport_profile()
    rclpy.init(signal_handler_options=rclpy.SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node("doctor", namespace=NAMESPACE)
        return _collect(node, config, seconds)
    finally:
        rclpy.try_shutdown()


def _collect(node: Node, config: DriverConfig, seconds: float) -> Heard:
    heard = Heard()
    image = config.image_topic.removesuffix("/compressed")
    cameras = {image: IMAGE_RAW, f"{image}/compressed": IMAGE_RAW_COMPRESSED}
    for name, topic in cameras.items():
        _subscribe(node, name, topic, lambda message: heard.items.append(encoded_from_message(message)), heard)
    _subscribe(node, config.imu_topic, IMU, lambda message: heard.items.append(imu_from_message(message)), heard)
    node.create_subscription(message_type(STATUS), STATUS.name, lambda message: _note(message, heard), quality(STATUS))
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    end_s = time.monotonic() + seconds
    while (left_s := end_s - time.monotonic()) > 0:
        executor.spin_once(min(left_s, 0.1))
    publishers = {name: node.get_publishers_info_by_topic(name) for name in (*cameras, config.imu_topic)}
    heard.has_camera = any(publishers[name] for name in cameras)
    heard.has_imu = bool(publishers[config.imu_topic])
    heard.findings += [*socket_findings(), *_topic_findings(publishers, heard, image, config.imu_topic)]
    heard.findings += [_status_finding(status) for _, status in sorted(heard.statuses.items())]
    executor.shutdown(timeout_sec=0)
    node.destroy_node()
    heard.items.sort(key=lambda item: item.stamp_ns)
    return heard


def _subscribe(node: Node, name: str, topic: Topic, take: Callable[[Any], None], heard: Heard) -> None:
    """Subscribe so that any publisher matches: best effort, volatile."""

    def handle(message: Any) -> None:
        try:
            take(message)
        except MessageError as error:
            heard.findings.append(Finding(Level.WARNING, name, f"malformed message: {error}"))

    profile = QoSProfile(
        depth=_DEPTH,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )
    node.create_subscription(message_type(topic), name, handle, profile)


def socket_findings() -> list[Finding]:
    """Say where Linux does not allow the sockets that the nodes ask for: through shared memory a crash may hold up the others."""
    if local_profile() != SHARED_MEMORY_PROFILE:
        return []
    text = "smaller than the nodes want, so a node that crashes may hold up all others: sudo sysctl -w net.core.rmem_max=4194304"
    return [Finding(Level.WARNING, "sockets", text)]


def _topic_findings(publishers: dict[str, list[Any]], heard: Heard, image: str, imu: str) -> list[Finding]:
    """Say which topics have no publisher, and where one publishes as best effort: such a one may lose frames."""
    findings = []
    if not heard.has_camera:
        text = f"nobody publishes '{image}' or '{image}/compressed'; start the driver, or name the topic with --topic image=/x"
        findings.append(Finding(Level.PROBLEM, "camera", text))
    if not heard.has_imu:
        text = f"nobody publishes '{imu}'; start the driver, or name the topic with --topic imu=/x"
        findings.append(Finding(Level.PROBLEM, "IMU", text))
    for name, found in publishers.items():
        lossy = [item.node_name for item in found if item.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT]
        if lossy:
            text = f"'{name}' is published as best effort by {', '.join(lossy)}: messages may be lost; publish reliably"
            findings.append(Finding(Level.WARNING, "topics", text))
    return findings


def _note(message: Any, heard: Heard) -> None:
    try:
        status = status_from_message(message)
    except MessageError:
        return
    heard.statuses[status.node] = status


def _status_finding(status: StageStatus) -> Finding:
    levels = {Health.OK: Level.GOOD, Health.WARN: Level.WARNING, Health.ERROR: Level.PROBLEM, Health.STALE: Level.WARNING}
    return Finding(levels[status.health], status.node, status.hint or status.state.value)
