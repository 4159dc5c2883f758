"""``vli live``: the graph for a camera and an IMU that are there, under names of their own, until it is told to stop."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy
from patience import wait
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage, Imu
from tiny_bag import TinyBag, write_calibration

from vli_bringup.tum import read_tum
from vli_common.node import set_transport_profile
from vli_common.types import NANOSECONDS
from vli_driver.bag_file import McapFile, RawMessage
from vli_mapping.map_file import load_map

pytestmark = pytest.mark.graph

IMAGES, IMU = "/camera/image_raw/compressed", "/imu"
NAMES = {IMAGES: "/scanner/image/compressed", IMU: "/scanner/imu"}
_START_S = 240.0


@pytest.fixture
def scanner() -> Iterator[Node]:
    """Return a node of a process of its own, as far as the middleware can tell."""
    set_transport_profile()
    context = Context()
    rclpy.init(context=context)
    node = rclpy.create_node("scanner", context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


def publish(node: Node, messages: list[RawMessage], rate: float) -> None:
    """Publish as a camera does, best effort, at the pace of the recording; wait until everybody listens.

    The nodes find out once a second that the camera is best effort, and hear it as such from then on.
    """
    kinds = {IMAGES: CompressedImage, IMU: Imu}
    publishers = {topic: node.create_publisher(kinds[topic], name, qos_profile_sensor_data) for topic, name in NAMES.items()}

    def are_heard() -> bool:
        for name, publisher in zip(NAMES.values(), publishers.values(), strict=True):
            readers = node.get_subscriptions_info_by_topic(name)
            if not readers or publisher.get_subscription_count() < len(readers):
                return False
        return True

    wait(are_heard, _START_S)
    begin_s = time.monotonic()
    for message in messages:
        due_s = begin_s + (message.log_ns - messages[0].log_ns) / NANOSECONDS / rate
        time.sleep(max(0.0, due_s - time.monotonic()))
        publishers[message.topic].publish(message.data)
    time.sleep(2.0)


def messages(bag: Path) -> list[RawMessage]:
    """Return images and IMU of a recording."""
    return list(McapFile(next(bag.glob("*.mcap"))).messages(set(NAMES)))


def live(calibration: Path, out: Path, *options: str) -> subprocess.Popen[str]:
    """Start the command."""
    names = ["--topic", f"image={NAMES[IMAGES].removesuffix('/compressed')}", "--topic", f"imu={NAMES[IMU]}"]
    command = [sys.executable, "-m", "vli_bringup.cli", "live", "--calib", str(calibration), "--out", str(out), *names, *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def scan(scanner: Node, bag: Path, calibration: Path, out: Path, rate: float = 1.0) -> tuple[int, str, str]:
    """Run the command on a recording that is published; return exit code, standard output and error."""
    process = live(calibration, out)
    killer = threading.Timer(_START_S, process.kill)
    killer.start()
    try:
        assert process.stderr.readline() == "vli live: ready; Ctrl-C ends the scan and writes the results\n"
        publish(scanner, messages(bag), rate)
        process.send_signal(signal.SIGINT)
        out_text, error_text = process.communicate(timeout=120)
        return process.returncode, out_text, error_text
    finally:
        killer.cancel()
        process.kill()


def test_noise_from_topics_of_other_names_reaches_the_graph_and_never_tracks(tmp_path: Path, scanner: Node) -> None:
    bag = TinyBag().write(tmp_path / "bag")
    code, _, told = scan(scanner, bag, write_calibration(tmp_path / "calibration.yaml"), tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert code == 1
    assert summary["frames_long"] + summary["frames_short"] > 100
    assert f"tracking never started in {summary['frames_long']} long frames: " in told
    assert (tmp_path / "out" / "timing.csv").read_text() == "stamp,latency_ms\n"


@pytest.mark.slow
def test_a_scan_that_is_ended_by_a_signal_has_everything_that_vli_run_writes(
    tmp_path: Path, scanner: Node, repository: Path
) -> None:
    demo = repository / "bags/demo"
    code, said, told = scan(scanner, demo / "bag", demo / "calibration.yaml", tmp_path / "out", rate=0.25)
    assert code == 0, told
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["points"] > 5_000
    assert f"{summary['points']} map points; results in" in said
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "cloud.png", "config.yaml", "covariance.csv", "map.ply", "map.vli", "summary.json", "timing.csv", "trajectory.tum",
        "trajectory_final.tum",
    }  # fmt: skip
    poses = len((tmp_path / "out" / "trajectory.tum").read_text().splitlines())
    assert poses == summary["frames_with_pose"] > 50
    assert len((tmp_path / "out" / "covariance.csv").read_text().splitlines()) == poses + 1


def test_a_scan_whose_command_is_killed_leaves_map_and_path_and_the_next_does_not_take_its_place(
    tmp_path: Path, scanner: Node, repository: Path
) -> None:
    demo, out = repository / "bags/demo", tmp_path / "out"
    calibration, saved = demo / "calibration.yaml", tmp_path / "out.partial" / "autosave.vli"
    path = saved.with_suffix(".tum")
    process = live(calibration, out, "--autosave", "1")
    try:
        assert process.stderr is not None
        assert process.stderr.readline().startswith("vli live: ready")
        publish(scanner, messages(demo / "bag"), 0.5)
        wait(saved.exists)
        wait(path.exists)
        wait(lambda: len(path.read_text().splitlines()) > 10)
    finally:
        process.kill()
        process.communicate()
    wait(lambda: len(load_map(saved)) > 3000)
    assert len(read_tum(path)) > 10
    again = live(calibration, out)
    assert again.wait(timeout=60.0) == 2
    assert again.stderr is not None
    told = again.stderr.read()
    assert f"'{tmp_path / 'out.partial'}' holds what is left of a scan that was cut off (autosave.tum, autosave.vli)" in told
    assert saved.exists()
