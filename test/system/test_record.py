"""``vli record`` in a graph: bit for bit what was published, from any publisher, to the last whole chunk of a killed one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import rclpy
from patience import wait
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Imu
from std_msgs.msg import String
from tiny_bag import TinyBag

from vli_common.node import set_transport_profile
from vli_driver.bag import BagReader, BagTopics
from vli_driver.bag_file import McapFile, RawMessage

pytestmark = pytest.mark.graph

IMAGES, IMU = "/camera/image_raw/compressed", "/imu"
_START_S = 120.0


@pytest.fixture(scope="module")
def node() -> Iterator[Node]:
    """Return a node in a domain apart from whatever else speaks ROS on this machine."""
    set_transport_profile()
    rclpy.init(signal_handler_options=rclpy.SignalHandlerOptions.NO)
    node = rclpy.create_node("camera")
    yield node
    node.destroy_node()
    rclpy.try_shutdown()


@contextmanager
def recording(out: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "vli_bringup.cli", "record", "--out", str(out), *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def stored(path: Path) -> list[RawMessage]:
    return list(McapFile(path).messages({IMAGES, IMU, "/vli/calibration"}))


def so_far(out: Path) -> list[RawMessage]:
    """Return what a recording that goes on has on disk."""
    path = out.with_name("out.partial") / "out_0.mcap"
    return stored(path) if path.exists() and path.stat().st_size > 8 else []


def data_of(messages: list[RawMessage], topic: str) -> list[bytes]:
    return [item.data for item in messages if item.topic == topic]


def play(messages: list[RawMessage], publishers: dict[str, Publisher]) -> None:
    """Publish serialised messages, faster than they were."""
    for message in messages:
        publishers[message.topic].publish(message.data)
        time.sleep(0.001)


def publishers_of(node: Node, reliability: ReliabilityPolicy) -> dict[str, Publisher]:
    profile = QoSProfile(depth=500, reliability=reliability)
    return {name: node.create_publisher(kind, name, profile) for name, kind in ((IMAGES, CompressedImage), (IMU, Imu))}


def are_heard(publishers: dict[str, Publisher]) -> bool:
    return all(item.get_subscription_count() for item in publishers.values())


def test_a_recording_has_bit_for_bit_what_was_published(tmp_path: Path, node: Node) -> None:
    played = stored(next(TinyBag().write(tmp_path / "bag").glob("*.mcap")))
    publishers = publishers_of(node, ReliabilityPolicy.RELIABLE)
    out = tmp_path / "out"
    with recording(out) as process:
        wait(lambda: are_heard(publishers), _START_S)
        play(played, publishers)
        process.send_signal(signal.SIGINT)
        text, told = process.communicate(timeout=60)
    assert (process.returncode, told) == (0, "")
    assert f"recording in '{out}'" in text
    (line,) = [line.split() for line in text.splitlines() if line.startswith("/imu")]
    assert (line[1], line[4]) == (str(sum(message.topic == IMU for message in played)), "0")
    recorded = stored(out / "out_0.mcap")
    for topic in (IMAGES, IMU):
        pairs = list(zip(data_of(recorded, topic), data_of(played, topic), strict=True))
        # RTPS fills a payload up to a multiple of four bytes.
        assert all(ours.startswith(theirs) and len(ours) < len(theirs) + 4 for ours, theirs in pairs)
    reader = BagReader(out)
    assert (reader.warnings, len(list(reader))) == ([], len(played))
    for item in publishers.values():
        node.destroy_publisher(item)


def test_a_killed_recording_is_read_up_to_a_second_before(tmp_path: Path, node: Node) -> None:
    publishers = publishers_of(node, ReliabilityPolicy.RELIABLE)
    out = tmp_path / "out"
    played = [RawMessage(0, IMU, item.data) for item in stored(next(TinyBag().write(tmp_path / "bag").glob("*.mcap")))
              if item.topic == IMU]  # fmt: skip
    partial = tmp_path / "out.partial" / "out_0.mcap"
    with recording(out) as process:
        wait(lambda: are_heard(publishers), _START_S)
        play(played, publishers)
        wait(lambda: len(so_far(out)) == len(played), _START_S)
        play(played[:5], publishers)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert not out.exists()
    reader = BagReader(partial.parent, BagTopics(image_required=False))
    assert reader.topics[IMU].count >= len(played)
    assert "is truncated" in reader.warnings[0]
    assert data_of(stored(partial), IMU)[: len(played)] == data_of(played, IMU)
    for item in publishers.values():
        node.destroy_publisher(item)


def test_best_effort_publishers_are_heard_and_nothing_heard_is_refused(tmp_path: Path, node: Node) -> None:
    publishers = publishers_of(node, ReliabilityPolicy.BEST_EFFORT)
    out = tmp_path / "out"
    with recording(out) as process:

        def grows() -> bool:
            publishers[IMU].publish(Imu())
            return len(so_far(out)) > 10

        wait(grows, _START_S)
        process.send_signal(signal.SIGTERM)
        _, told = process.communicate(timeout=60)
    assert process.returncode == 0
    for name in (IMU, IMAGES):
        assert f"vli record: '{name}' is published as best effort: messages may be lost; what is lost is counted\n" in told
    assert "[WARN]" not in told
    assert "reliability: best_effort" in (out / "metadata.yaml").read_text()
    for item in publishers.values():
        node.destroy_publisher(item)
    assert main_in_this_domain("--out", str(tmp_path / "none"), "--duration", "0.5") == (
        2,
        "vli: nothing was recorded: no message came on '/camera/image_raw', '/camera/image_raw/compressed', "
        "'/camera/camera_info', '/camera/exposure', '/imu'; start the driver, or name its topics with --topic\n",
    )
    assert not (tmp_path / "none.partial").exists()


def main_in_this_domain(*arguments: str) -> tuple[int, str]:
    command = [sys.executable, "-m", "vli_bringup.cli", "record", *arguments]
    result = subprocess.run(command, capture_output=True, text=True, timeout=_START_S, check=False)
    return result.returncode, result.stderr


def test_all_takes_what_late_joiners_are_given(tmp_path: Path, node: Node) -> None:
    """The calibration is published once, before anybody records; its writer keeps it."""
    profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = node.create_publisher(String, "/vli/calibration", profile)
    publisher.publish(String(data="cam0: {}"))
    out = tmp_path / "out"
    with recording(out, "--all") as process:
        wait(lambda: len(so_far(out)) == 1, _START_S)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    assert process.returncode == 0
    assert "durability: transient_local" in (out / "metadata.yaml").read_text()
    assert b"cam0: {}" in stored(out / "out_0.mcap")[0].data
    node.destroy_publisher(publisher)
