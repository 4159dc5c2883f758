"""The base of every node: decode → call → publish is all that is left to the node itself."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import rclpy
from std_msgs.msg import Header, String

from vli_common.calibration import Calibration, load_calibration, parse_calibration, to_yaml
from vli_common.errors import CalibrationError, MessageError, VliError
from vli_common.messages import Session, session_from_message, session_to_message, status_from_message, status_to_message
from vli_common.node.backlog import Backlog
from vli_common.node.hooks import StageHooks
from vli_common.node.inputs import Input
from vli_common.node.neighbours import Neighbours, News, whole_number
from vli_common.node.parameters import NodeConfig, NodeParameters
from vli_common.node.transport import message_type, quality
from vli_common.node.working import WorkingNode
from vli_common.status import Health, LatencyMeter, NodeState, StageStatus
from vli_common.topics import CALIBRATION, DIAGNOSTICS, SESSION, STATUS
from vli_common.types import Counters, Mode

T = TypeVar("T")

_STATUS_PERIOD_S = 1.0
_LOOK_PERIOD_S = 0.1
_ABOUT_THE_NODE = {topic.name for topic in (STATUS, DIAGNOSTICS, SESSION, CALIBRATION)}
_WAITING_HINT = "waiting for a calibration: give 'calibration_file' to the driver node or to this one"
_RUNNING = (NodeState.READY, NodeState.PAUSED, NodeState.FINISHED)
_ANSWERED = (News.FIRST, News.RESTARTED)
_IGNORED = {News.NAMESAKE: "status_of_namesakes", News.TOO_MANY: "status_of_too_many_nodes"}


class VliNode(StageHooks, WorkingNode):
    """Parameters, calibration, session, worker, status, services, lifecycle.

    A subclass makes its publishers and calls :meth:`receive` in its constructor, and overrides what it needs of the hooks.

    Args:
        name: of the executable.
        configs: config dataclass → prefix of its parameters (``""`` for none).
        needs_calibration: False for a node that works without one.
        fixed: those of ``configs`` that the node reads in its constructor.

    Raises:
        ConfigError: an invalid parameter.
    """

    def __init__(
        self, name: str, configs: Mapping[type, str], needs_calibration: bool = True, fixed: Collection[type] = ()
    ) -> None:
        super().__init__(name)
        self.parameters = NodeParameters(self, configs, fixed)
        self.node_config = self.parameters.config(NodeConfig)
        self.mode = Mode(self.node_config.mode)
        self.calibration: Calibration | None = None
        self.session = 0
        self._newest_session = 0
        self.counters = Counters()
        self.latency = LatencyMeter()
        self.state = NodeState.UNCONFIGURED
        self.failure: str | None = None
        self._needs_calibration = needs_calibration
        self._hint = "waiting for a lifecycle manager to configure it: 'autostart' is false"
        self._calibration_hint = ""
        self._backlog = Backlog()
        self.is_behind = False
        """True where the message that is being handled came too long ago, and those before it too: leave out what can be."""
        self._told = ("", False)
        self._handled = 0
        self._started_ns = time.time_ns()
        self._neighbours = Neighbours(self.get_name(), self._started_ns)
        self._offered: Calibration | None = None
        self._connect()

    @property
    def started_ns(self) -> int:
        """Wall clock at which the node was made: tells it from its predecessor of the same name."""
        return self._started_ns

    @property
    def others(self) -> Mapping[str, StageStatus]:
        """The newest status of each node, this one too."""
        return self._neighbours.statuses

    @property
    def newest_session(self) -> int:
        """Number of the newest session that was heard of; the worker may still be busy with the one before."""
        return self._newest_session

    def raise_session(self, reason: str, stamp_ns: int = 0) -> Session:
        """Begin a new session here and tell all nodes."""
        session = Session(self._newest_session + 1, reason, stamp_ns)
        self.send(SESSION, session_to_message(session))
        self._begin(session)
        return session

    def set_state(self, state: NodeState, hint: str = "") -> None:
        """Change the state and say so at once."""
        self.state, self._hint = state, hint
        self.publish_status()

    # Life

    def start(self) -> None:
        """Start the worker and, unless ``autostart`` is false, configure and activate.

        Raises:
            VliError: the node cannot be configured.
        """
        self._worker.start()
        if self.node_config.autostart:
            self.bring_up()
        else:
            self.publish_status()

    def configure(self) -> None:
        """Read the calibration; the stage is made as soon as there is one."""
        self.check()
        self.calibration = self._load_calibration() if self.node_config.calibration_file else self._offered
        if self.calibration is not None or not self._needs_calibration:
            self._make_ready()
        else:
            self.set_state(NodeState.WAITING, _WAITING_HINT)

    def activate(self) -> None:
        """Process what comes from now on."""
        self.enqueue(self._go_on)

    def deactivate(self) -> None:
        """Bring to an end what is under way; what comes from now on is dropped and counted."""

        def rest() -> None:
            if self.state is NodeState.READY:
                self.on_pause()
            if self.state in (NodeState.READY, NodeState.PAUSED):
                self.set_state(NodeState.INACTIVE)

        self.enqueue(rest)

    def clean_up(self) -> None:
        """Drop stage and calibration."""

        def drop() -> None:
            self.drop_stage()
            self.calibration = None
            self.set_state(NodeState.UNCONFIGURED, "cleaned up")

        self.call(drop)

    def publish_status(self) -> None:
        """Publish ``status`` and ``/diagnostics``: all scanners share that, so that there the namespace is part of the name."""
        status = self._status()
        self._neighbours.take(status)
        message = status_to_message(status)
        self.send(STATUS, message)
        message.status[0].name = self.get_fully_qualified_name().lstrip("/")
        self.send(DIAGNOSTICS, message)

    def _connect(self) -> None:
        for topic in (STATUS, DIAGNOSTICS, SESSION):
            self.advertise(topic)
        self.create_subscription(Header, SESSION.name, self._on_session_message, quality(SESSION))
        self.create_subscription(message_type(STATUS), STATUS.name, self._on_status, quality(STATUS, reading=True))
        self.create_subscription(String, CALIBRATION.name, self._on_calibration, quality(CALIBRATION))
        self.every(_STATUS_PERIOD_S, self.publish_status)
        self.every(_LOOK_PERIOD_S, self._look_around)
        self.every(_STATUS_PERIOD_S, self._match)
        self.serve("reset", lambda: f"session {self.raise_session(f'reset of {self.get_name()}').number}")
        self.serve("pause", self._pause)
        self.serve("resume", self._resume)

    def _look_around(self) -> None:
        """See whether this is the end, and say at once what others wait for.

        That an input has found its publisher, or lost it, and that the node has begun to work.
        """
        self._check_finish()
        now = (self._unmatched(), self._is_working())
        if now != self._told:
            self._told = now
            self.publish_status()

    def _is_working(self) -> bool:
        """Return True once data of the session have been handled; of a source, once it has sent some."""
        return bool(self._handled) if self._inputs else any(name not in _ABOUT_THE_NODE for name in list(self._sent.values))

    def _make_ready(self) -> None:
        self.set_state(NodeState.WARMING)

        def prepare() -> None:
            self.create_stage(self.calibration)
            self.on_session(Session(self.session, "start"))
            self.set_state(NodeState.INACTIVE)
            self._go_on()

        self.enqueue(prepare)

    def _go_on(self) -> None:
        """Become ready, where the stage is there and the node active."""
        if self.is_active and self.state is NodeState.INACTIVE:
            self.on_resume()
            self.set_state(NodeState.READY)

    def _process(
        self, entry: Input, read: Callable[[Any], T], handle: Callable[[T], None], message: Any, arrived_s: float
    ) -> None:
        if not self.is_active or self.state not in (NodeState.READY, NodeState.FINISHED):
            state = self.state if self.is_active else NodeState.INACTIVE
            self.counters.add(f"{entry.topic.name}_while_{state.value}")
            return
        self.is_behind = self._backlog.is_behind(arrived_s)
        if entry.is_shed(self.is_behind):
            self._worker.dropped.add(entry.topic.name)
            return
        try:
            value = read(message)
        except MessageError as error:
            self.counters.add(f"{entry.topic.name}_malformed")
            self.get_logger().warning(f"'{entry.name}': {error}", throttle_duration_sec=5.0)
            return
        if getattr(value, "session", self.session) != self.session:
            self.counters.add(f"{entry.topic.name}_of_other_sessions")
            return
        handle(value)
        self._handled += 1
        self.latency.add(time.monotonic() - arrived_s)

    def fail(self, error: Exception) -> None:
        """A stage raised: the node ends, since what it would go on with is not known to be sound."""
        if not rclpy.ok():
            return
        self.failure = f"{type(error).__name__}: {error}"
        self.get_logger().error(f"{self.get_name()} failed: {self.failure}")
        self.get_logger().debug(traceback.format_exc())
        self.set_state(NodeState.FAILED, self.failure)

    # Calibration

    def _load_calibration(self) -> Calibration:
        config = self.node_config
        imu = Path(config.imu_calibration_file) if config.imu_calibration_file else None
        return load_calibration(Path(config.calibration_file), self.mode, imu)

    def _on_calibration(self, message: String) -> None:
        try:
            calibration = parse_calibration(message.data, self.mode)
        except CalibrationError as error:
            self._calibration_hint = str(error)
            self.get_logger().error(self._calibration_hint)
            return
        self._offered = calibration
        if self.state is NodeState.WAITING:
            self.calibration = calibration
            self._make_ready()
        elif self.calibration is not None and to_yaml(calibration.document) != to_yaml(self.calibration.document):
            used = self.node_config.calibration_file or "the first one"
            self._calibration_hint = f"the calibration on the topic differs from '{used}', which is used"
            self.get_logger().warning(self._calibration_hint)

    # Sessions

    def _on_session_message(self, message: Header) -> None:
        try:
            session = session_from_message(message)
        except MessageError as error:
            self.counters.add("session_malformed")
            self.get_logger().warning(str(error), throttle_duration_sec=5.0)
            return
        if session.number > self._newest_session:
            # Every node keeps it for those that come later: who raised it may be gone by then.
            self.send(SESSION, message)
            self._begin(session)

    def _begin(self, session: Session) -> None:
        """Drop what waits, then let the stage start anew; data that come from now on are of the new session."""
        self._newest_session = session.number
        self.counters.add("dropped_by_session", self._worker.clear())
        for entry in self._inputs.values():
            entry.received = 0

        def begin() -> None:
            self.session, self._sent, self._handled = session.number, Counters(), 0
            if self.parameters.changed and self.state not in (NodeState.UNCONFIGURED, NodeState.WAITING):
                self.parameters.changed = False
                self.create_stage(self.calibration)
            if self.state in (NodeState.READY, NodeState.FINISHED, NodeState.PAUSED, NodeState.INACTIVE):
                self.on_session(session)
            if self.state is NodeState.FINISHED:
                self.state = NodeState.READY if self.is_active else NodeState.INACTIVE
            self.publish_status()

        self.enqueue(begin)

    # End of the input

    def _on_status(self, message: Any) -> None:
        try:
            status = status_from_message(message)
        except MessageError:
            self.counters.add("status_malformed")
            return
        news = self._neighbours.take(status)
        if news in _IGNORED:
            self.counters.add(_IGNORED[news])
            return
        if news is News.RESTARTED:
            self.get_logger().warning(f"'{status.node}' was started anew")
            self.enqueue(partial(self.on_restart, status.node))
        if (session := whole_number(status, "session")) > self._newest_session:
            self._begin(Session(session, f"heard of from {status.node}"))
        if status.values.get("session") == str(self._newest_session):
            self._note_sent(status)
        if news in _ANSWERED:
            # Who has just come hears of this node at once, and of its session; that may be all it waits for.
            self.publish_status()

    def _note_sent(self, status: StageStatus) -> None:
        for name, entry in self._inputs.items():
            if f"sent.{name}" in status.values and status.node != self.get_name():
                entry.note_sent(status.node, whole_number(status, f"sent.{name}"), self._newest_session)

    def _check_finish(self) -> None:
        """Finish once every source has, and all that it sent has come and is worked off."""
        inputs = [entry for entry in self._inputs.values() if entry.ends]
        if self.state is not NodeState.READY or not inputs or not self._worker.is_idle:
            return
        finished = self._neighbours.finished(self.session)
        if all(entry.has_ended(finished) for entry in inputs):

            def finish() -> None:
                self.on_finish()
                self.set_state(NodeState.FINISHED)

            self.enqueue(finish)

    # Services and status

    def _check_running(self) -> None:
        """Raise where to pause or resume would come to nothing.

        Raises:
            VliError: the node is not at work.
        """
        if self.state not in _RUNNING:
            raise VliError(f"{self.get_name()} is '{self.state.value}', expected {', '.join(state.value for state in _RUNNING)}")

    def _pause(self) -> str:
        self._check_running()

        def pause() -> None:
            if self.state is NodeState.READY:
                self.on_pause()
                self.set_state(NodeState.PAUSED, "paused by service")

        self.enqueue(pause)
        return "pausing"

    def _resume(self) -> str:
        self._check_running()

        def resume() -> None:
            if self.state is NodeState.PAUSED:
                self.on_resume()
                self.set_state(NodeState.READY)

        self.enqueue(resume)
        return "resuming"

    def _status(self) -> StageStatus:
        health, hint, values = self.stage_status()
        dropped = self._worker.dropped.values
        cut_off = next((entry.cut_off for entry in self._inputs.values() if entry.cut_off), "")
        twice = self._neighbours.hint
        if dropped or cut_off or twice:
            health = Health.WARN if health is Health.OK else health
        if dropped:
            hint = hint or f"too slow: {', '.join(f'{count} of {name}' for name, count in dropped.items())} dropped"
        if self.state is NodeState.FAILED:
            health = Health.ERROR
        return StageStatus(
            stamp_ns=time.time_ns(),
            node=self.get_name(),
            health=health,
            state=self.state,
            hint=self._hint or self._calibration_hint or twice or cut_off or hint,
            values={
                "session": str(self.session),
                "started_ns": str(self.started_ns),
                "handled": str(self._handled),
                **values,
                **self._figures(),
            },
        )

    def _figures(self) -> dict[str, str]:
        figures = {"unmatched": self._unmatched(), "cpu_s": f"{time.process_time():.2f}"}
        for name, entry in self._inputs.items():
            figures |= entry.figures(self._worker.waiting(name))
        percentiles = self.latency.percentiles_ms()
        if percentiles:
            figures["latency_p50_ms"], figures["latency_p99_ms"] = (f"{value:.2f}" for value in percentiles)
        figures |= {f"sent.{name}": str(count) for name, count in self._sent.values.items()}
        figures |= {f"dropped.{name}": str(count) for name, count in self._worker.dropped.values.items()}
        for prefix, counters in (("node", self.counters), ("stage", self.stage_counters())):
            figures |= {f"{prefix}.{name}": str(count) for name, count in list(counters.values.items())}
        return figures
