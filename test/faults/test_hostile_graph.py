"""All nodes but the driver, in one process, fed with a recording into which hostile copies of every message are mixed."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from hostile import Dice, mutated
from rclpy.serialization import deserialize_message

from vli_backend.nodes.backend_node import BackEndNode
from vli_common import messages
from vli_common.calibration import load_calibration
from vli_common.errors import MessageError
from vli_common.node import VliNode
from vli_common.node.transport import message_type
from vli_common.status import NodeState
from vli_common.topics import IMAGE_RAW, IMAGE_RAW_COMPRESSED, IMU, POSE, SESSION, Topic
from vli_common.types import ImuSample
from vli_driver.bag import BagReader
from vli_driver.nodes.demux_node import DemuxNode
from vli_frontend.nodes.frontend_node import FrontEndNode
from vli_mapping.nodes.mapping_node import MappingNode

pytestmark = pytest.mark.slow

HOSTILE_S, CLEAN_S = 3.0, 4.0
SHARE = 0.3


class Graph:
    """Nodes that are called, not spun: what one sends, the others get at once.

    Args:
        directory: of a recording.
        random: decides what is mixed in.
    """

    def __init__(self, directory: Path, random: np.random.Generator) -> None:
        self.poses = 0
        self.hostile: Counter[str] = Counter()
        self._random, self._readers = random, dict[str, list[Any]]()
        self._sent: deque[tuple[str, Any]] = deque()
        calibration = load_calibration(directory / "calibration.yaml")
        self.nodes = [self._made(kind, calibration) for kind in (DemuxNode, FrontEndNode, BackEndNode, MappingNode)]

    def put(self, topic: str, message: Any, share: float) -> None:
        """Hand over a message, and all that the nodes send because of it; a share of them in a hostile copy first."""
        self._sent.append((topic, message))
        while self._sent:
            topic, message = self._sent.popleft()
            self.poses += topic == POSE.name
            if topic == SESSION.name:
                self._begin(messages.session_from_message(message))
                continue
            for node, read, handle in self._readers.get(topic, ()):
                if self._random.random() < share:
                    self.hostile[topic] += self._process(node, read, handle, self._mutation(message))
                self._process(node, read, handle, message)

    def _mutation(self, message: Any) -> Any:
        """Return a hostile copy; most with the stamp of the good one, or nearly all would fail at the first check."""
        bad = mutated(message, Dice(self._random.bytes(48)))
        if self._random.random() < 0.9:
            bad.header.stamp = message.header.stamp
        return bad

    @staticmethod
    def _process(node: VliNode, read: Any, handle: Any, message: Any) -> bool:
        """Do what the worker of a node does; return True where the message was taken for a good one."""
        try:
            value = read(message)
        except MessageError:
            return False
        if getattr(value, "session", node.session) != node.session:
            return False
        handle(value)
        return True

    def _begin(self, session: messages.Session) -> None:
        for node in self.nodes:
            if session.number > node.session:
                node.session = node._newest_session = session.number
                node.on_session(session)

    def _made(self, kind: type[VliNode], calibration: Any) -> VliNode:
        readers: list[tuple[str, Any, Any]] = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(kind, "receive", lambda _, topic, read, handle, *args, **options: readers.append((topic, read, handle)))
            node = kind()
        for topic, read, handle in readers:
            self._readers.setdefault(topic.name, []).append((node, read, handle))
        node.send = lambda topic, message: self._sent.append((topic.name, _as_message(topic, message)))
        node.enqueue = lambda job: job()
        node.has_listener, node.publish_status = (lambda topic: False), (lambda: None)
        node.calibration, node.state = calibration, NodeState.READY
        node.create_stage(calibration)
        node.on_session(messages.Session(0, "start"))
        return node


def _as_message(topic: Topic, message: Any) -> Any:
    """Return what a topic carries as a message, also where it was sent as bytes."""
    return deserialize_message(message, message_type(topic)) if isinstance(message, bytes) else message


@pytest.fixture
def graph(repository: Path) -> Iterator[Graph]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        rclpy.init(args=[])
        made = Graph(repository / "bags" / "demo", np.random.default_rng(4))
        yield made
        for node in made.nodes:
            node.destroy_node()
        rclpy.try_shutdown()


def test_hostile_messages_end_no_node_and_the_scan_goes_on_once_they_stop(graph: Graph, repository: Path) -> None:
    counts = []
    for share, start_s, duration_s in ((SHARE, 0.0, HOSTILE_S), (0.0, HOSTILE_S, CLEAN_S)):
        before = graph.poses
        for item in BagReader(repository / "bags" / "demo" / "bag", start_s=start_s, duration_s=duration_s):
            if isinstance(item, ImuSample):
                graph.put(IMU.name, _as_message(IMU, messages.imu_to_cdr(item)), share)
            else:
                topic = IMAGE_RAW_COMPRESSED if item.compressed else IMAGE_RAW
                graph.put(topic.name, _as_message(topic, messages.encoded_to_cdr(item)), share)
        counts.append(graph.poses - before)
    assert sum(graph.hostile.values()) > 100
    assert set(graph.hostile) >= {IMU.name, IMAGE_RAW_COMPRESSED.name, "image_long", "laser_points", "tracks", "preintegration"}
    assert counts[1] > 0.5 * 30 * CLEAN_S
