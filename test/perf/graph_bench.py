"""A graph under measurement: started over a bag, watched from outside; and what the same bag costs offline."""

from __future__ import annotations

import os
import struct
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from vli_bringup.graph import SCANNER, NodeDescription, Playback, describe_graph
from vli_bringup.listener import LISTENER, GraphListener
from vli_bringup.losses import undelivered
from vli_bringup.pipeline import Pipeline, Stages
from vli_bringup.processes import GraphError, NodeProcesses
from vli_bringup.recorder import Recorder
from vli_bringup.settings import Settings, to_yaml
from vli_bringup.trajectory_metrics import associate, rms, trajectory_errors
from vli_bringup.tum import Trajectory
from vli_bringup.warm_up import warm_up
from vli_bringup.watch import GraphWatch
from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration, load_calibration
from vli_common.messages import status_from_message
from vli_common.node.transport import message_type, quality
from vli_common.status import NodeState, StageStatus
from vli_common.topics import (
    BIAS,
    IMAGE_RAW,
    IMAGE_RAW_COMPRESSED,
    MAP_CONSTRAINTS,
    ODOMETRY,
    POSE,
    RELOCALISATION,
    STATUS,
    Topic,
)
from vli_common.types import NANOSECONDS, EncodedImage, Mode
from vli_driver.bag import BagReader, BagTopics
from vli_driver.decode import decode

NODES = [node.executable for node in describe_graph(Path("none"))]
MAPPING = "mapping_node"
_START_S = 300.0
_STAMP = struct.Struct("<iI")
_CDR_HEADER = 4
_FEEDBACK = {topic.name for topic in (BIAS, ODOMETRY, MAP_CONSTRAINTS, RELOCALISATION)}
_PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class Recording:
    """A directory with ``bag`` and ``calibration.yaml``, perhaps ``truth.tum``."""

    directory: Path

    @property
    def bag(self) -> Path:
        """The bag to play."""
        return self.directory / "bag"

    @property
    def calibration_path(self) -> Path:
        """The calibration the driver publishes."""
        return self.directory / "calibration.yaml"

    @property
    def calibration(self) -> Calibration:
        """The same, read."""
        return load_calibration(self.calibration_path)


class Meter:
    """When each long frame was published and when its pose came, by this process's clock.

    Args:
        listener: in the graph.
    """

    def __init__(self, listener: GraphListener) -> None:
        self._published_s: dict[int, float] = {}
        self._latencies: list[tuple[float, float]] = []
        for topic in (IMAGE_RAW, IMAGE_RAW_COMPRESSED):
            self._subscribe(listener, topic, self._publish)
        self._subscribe(listener, POSE, self._pose)

    def latencies_ms(self, since_s: float = 0.0, until_s: float = np.inf) -> FloatArray:
        """Return the time (N,) from image to pose of every frame posed in [since, until) monotonic seconds, in order."""
        return 1e3 * np.array([latency_s for at_s, latency_s in self._latencies if since_s <= at_s < until_s])

    def _publish(self, stamp_ns: int, now_s: float) -> None:
        self._published_s[stamp_ns] = now_s

    def _pose(self, stamp_ns: int, now_s: float) -> None:
        # A bag that is played again has the same stamps again.
        if (published_s := self._published_s.pop(stamp_ns, None)) is not None:
            self._latencies.append((now_s, now_s - published_s))

    @staticmethod
    def _subscribe(listener: GraphListener, topic: Topic, take: Callable[[int, float], None]) -> None:
        def note(serialised: bytes) -> None:
            seconds, nanoseconds = _STAMP.unpack_from(serialised, _CDR_HEADER)
            take(seconds * NANOSECONDS + nanoseconds, time.monotonic())

        listener.node.create_subscription(message_type(topic), topic.name, note, quality(topic, reading=True), raw=True)


class PlayedSessions:
    """What each node said as it finished a session of a bag that is played again and again.

    Args:
        listener: in the graph.
    """

    def __init__(self, listener: GraphListener) -> None:
        self._finished: dict[str, dict[str, StageStatus]] = defaultdict(dict)
        listener.node.create_subscription(message_type(STATUS), STATUS.name, self._note, quality(STATUS, reading=True))

    @property
    def complete(self) -> list[list[StageStatus]]:
        """The statuses of all nodes, of each session that all have finished."""
        return [list(statuses.values()) for statuses in self._finished.values() if set(statuses) == set(NODES)]

    def undelivered(self) -> Counter[str]:
        """Return ``node.topic`` → messages that did not reach a node.

        Feedback that comes after a node has finished is none of these.
        """
        lost = sum((undelivered(statuses) for statuses in self.complete), Counter[str]())
        return Counter({name: count for name, count in lost.items() if name.partition(".")[2] not in _FEEDBACK})

    def _note(self, message: Any) -> None:
        status = status_from_message(message)
        if status.state is NodeState.FINISHED:
            self._finished[status.values["session"]][status.node] = status


@dataclass
class Graph:
    """A running graph and who watches it."""

    processes: NodeProcesses
    listener: GraphListener
    watch: GraphWatch

    @property
    def recorder(self) -> Recorder:
        """Of the present session."""
        return self.listener.sessions.recorder

    def wait(self, condition: Callable[[], bool], timeout_s: float = _START_S) -> float:
        """Spin until a condition holds; return the seconds that took.

        Raises:
            GraphError: it does not hold in time, or a node ended for good.
        """
        begin_s = time.monotonic()
        while not condition():
            self.processes.check()
            if time.monotonic() - begin_s > timeout_s:
                said = (
                    f"{name} {status.state.value} session {status.values.get('session')} lacks '{status.values.get('unmatched')}'"
                    for name, status in self.listener.statuses.items()
                )
                raise GraphError(f"waited for {timeout_s:g} s in vain: {', '.join(said)}")
            self.listener.spin()
            self.watch.look(self.listener.statuses, self.listener.heard_s)
        return time.monotonic() - begin_s

    def wait_for_frames(self) -> None:
        """Return when the driver has begun to play."""
        self.wait(lambda: self.listener.value(SCANNER, "position_ns") > 0)

    def play(self) -> None:
        """Return when the last node has finished."""
        self.wait_for_frames()
        self.wait(lambda: self.listener.state(MAPPING) is NodeState.FINISHED, 3600.0)

    def value(self, node: str, name: str) -> float:
        """Return a number of the newest status of a node, 0 where it has none."""
        status = self.listener.statuses.get(node)
        return float(status.values.get(name, "0") or 0) if status else 0.0

    def is_linked(self, node: str, since_ns: int) -> bool:
        """Return True where a node that was killed at a wall clock time works again, in one session with the others.

        It has played, or handled, data of this session.
        """
        statuses = [self.listener.statuses.get(name) for name in NODES]
        if self.value(node, "started_ns") <= since_ns or None in statuses:
            return False
        if not self.value(node, "position_ns" if node == SCANNER else "handled"):
            return False
        known = [status for status in statuses if status is not None]
        works = all(status.state in (NodeState.READY, NodeState.FINISHED) and not status.values["unmatched"] for status in known)
        return works and len({status.values["session"] for status in known}) == 1


@contextmanager
def graph(
    recording: Recording,
    directory: Path,
    rate: float = 1.0,
    duration_s: float | None = None,
    own: Mapping[str, Any] | None = None,
) -> Iterator[Graph]:
    """Run the graph over a bag.

    Args:
        recording: to play.
        directory: for the parameter file.
        rate: bag seconds a second.
        duration_s: of the bag; all where not given.
        own: further parameters of the driver.
    """
    parameter_file = directory / "vli.yaml"
    parameter_file.write_text(to_yaml(Settings()))
    playback = Playback(recording.bag, rate, 0.0, duration_s)
    nodes = describe_graph(recording.calibration_path, playback=playback, audience=LISTENER)
    with (
        NodeProcesses([_own(node, own or {}) for node in nodes], parameter_file) as processes,
        GraphListener(recording.calibration) as listener,
    ):
        yield Graph(processes, listener, GraphWatch(processes))


def _own(node: NodeDescription, driver: Mapping[str, Any]) -> NodeDescription:
    """Return a node that is started again when it is killed, whichever it is; the driver with parameters of its own."""
    further = driver if node.executable == SCANNER else {}
    return replace(node, parameters={**node.parameters, **further}, respawn=True)


def resident_mb(pid: int) -> float:
    """Return the memory of a process that is its own, without what it shares (libraries, transport)."""
    _, resident, shared, *_ = Path(f"/proc/{pid}/statm").read_text().split()
    return (int(resident) - int(shared)) * _PAGE / 1e6


@dataclass(frozen=True)
class Offline:
    """The same bag through the stages alone: processor time of each node's part, and the trajectory."""

    recorder: Recorder
    cpu_s: dict[str, float] = field(default_factory=dict)

    def live(self) -> Trajectory:
        """Return the poses as they were published."""
        return live(self.recorder)


class _Timed:
    """Stands for a stage object; adds the processor time of its methods to an account.

    Args:
        stage: the object.
        account: node → seconds.
        node: that runs this stage in the graph.
    """

    def __init__(self, stage: Any, account: dict[str, float], node: str) -> None:
        self._stage, self._account, self._node = stage, account, node

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._stage, name)
        if not callable(value):
            return value

        def timed(*args: Any, **options: Any) -> Any:
            begin_s = time.thread_time()
            try:
                return value(*args, **options)
            finally:
                self._account[self._node] = self._account.get(self._node, 0.0) + time.thread_time() - begin_s

        return timed

    def __setattr__(self, name: str, value: Any) -> None:
        if name.startswith("_"):
            object.__setattr__(self, name, value)
        else:
            setattr(self._stage, name, value)


def run_offline(recording: Recording, duration_s: float | None = None) -> Offline:
    """Return what the stages take for a bag, without any transport; reading it counts as the driver's part."""
    warm_up()
    result = Offline(Recorder(recording.calibration))
    stages = Stages.create(recording.calibration, Settings(), Mode.VLI_SLAM)
    for name, node in (
        ("demultiplexer", "demux_node"),
        ("scanner", "demux_node"),
        ("front_end", "frontend_node"),
        ("back_end", "backend_node"),
        ("mapper", MAPPING),
    ):
        setattr(stages, name, _Timed(getattr(stages, name), result.cpu_s, node))
    pipeline = Pipeline(stages, Mode.VLI_SLAM)
    items = iter(BagReader(recording.bag, BagTopics(), 0.0, duration_s))
    while True:
        begin_s = time.thread_time()
        item = next(items, None)
        result.cpu_s[SCANNER] = result.cpu_s.get(SCANNER, 0.0) + time.thread_time() - begin_s
        if item is None:
            break
        if isinstance(item, EncodedImage):
            # Done in another thread of the pipeline; here it is the processor time that counts.
            begin_s = time.thread_time()
            decode(item)
            result.cpu_s["demux_node"] = result.cpu_s.get("demux_node", 0.0) + time.thread_time() - begin_s
        result.recorder.add(pipeline.push(item))
    result.recorder.add(pipeline.flush())
    return result


def live(recorder: Recorder) -> Trajectory:
    """Return the poses as they were published."""
    stamps = sorted(recorder.live)
    return Trajectory(np.array(stamps, np.int64), np.stack([recorder.live[stamp] for stamp in stamps]))


def rmse_mm(live: Trajectory, truth: Trajectory) -> float:
    """Return the translation RMSE of a trajectory."""
    return 1e3 * rms(np.linalg.norm(trajectory_errors(associate(live, truth), np.eye(4)).translation, axis=1))
