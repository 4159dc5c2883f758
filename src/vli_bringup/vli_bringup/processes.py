"""The nodes of a graph as child processes: started together, watched, stopped together."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import IO

import yaml

from vli_bringup.graph import NodeDescription
from vli_bringup.node_starter import NodeServer, Process, ServedProcess, last_line, start_singly
from vli_common.errors import VliError
from vli_common.node.shared_memory import remove_dead_segments
from vli_common.node.transport import use_fresh_ports

MAX_RESTARTS = 3
"""Of one node within a minute."""
_RESTART_PERIOD_S = 60.0
_FINAL_CODES = (0, 2)
"""Of :func:`vli_common.node.run_node`: told to stop, could not start. It would be the same again."""
_STOP_S = 5.0
_WAIT_S = 0.1


class GraphError(VliError):
    """A node of the graph could not start, or failed."""


@dataclass
class _Child:
    """A node, its process of now, and when its predecessors were started in its place."""

    node: NodeDescription
    arguments: list[str]
    process: Process
    log: IO[bytes]
    restarts: int = 0
    recent: deque[float] = field(default_factory=lambda: deque(maxlen=MAX_RESTARTS))

    @property
    def is_started(self) -> bool:
        """False while the server still loads."""
        return not isinstance(self.process, ServedProcess) or self.process.started_pid is not None


class NodeProcesses:
    """Context manager: all nodes run inside, none is left after.

    A server loads what they have in common once and forks them, see :mod:`vli_bringup.node_server`. A node that crashes is
    started again by :meth:`check`, three times a minute at most, while the others go on; one that cannot start, or was told to
    stop, is not.

    Args:
        nodes: see :func:`vli_bringup.graph.describe_graph`.
        parameter_file: for all nodes, in the form of config/vli.yaml.
        tell: gets one line for every node that is started again; writes it on standard error unless given.
    """

    def __init__(self, nodes: Sequence[NodeDescription], parameter_file: Path, tell: Callable[[str], None] | None = None) -> None:
        self._nodes, self._parameter_file = nodes, parameter_file
        self._tell = tell or _write_line
        self._children: dict[str, _Child] = {}
        self._server: NodeServer | None = None
        self._directory = tempfile.TemporaryDirectory(prefix="vli-graph-")

    def __enter__(self) -> NodeProcesses:
        """Have every node started: at once, or as soon as the server has loaded them."""
        self._server = NodeServer([node.module for node in self._nodes])
        for node in self._nodes:
            own = Path(self._directory.name) / f"{node.executable}.yaml"
            own.write_text(yaml.safe_dump({f"/**/{node.executable}": {"ros__parameters": dict(node.parameters)}}))
            files = [argument for path in (self._parameter_file, own) for argument in ("--params-file", str(path))]
            arguments = ["--ros-args", *files]
            self._children[node.executable] = _Child(node, arguments, *self._start(node, arguments))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Stop every node: politely, then firmly."""
        for sign in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            running = [child.process for child in self._children.values() if child.is_started and child.process.poll() is None]
            for process in running:
                process.send_signal(sign)
            _wait(running, time.monotonic() + _STOP_S)
        if self._server is not None:
            self._server.close()
        for child in self._children.values():
            child.log.close()
        remove_dead_segments()
        self._directory.cleanup()

    def check(self) -> None:
        """Start again what has crashed.

        Raises:
            GraphError: a node has ended for good; with its own last line.
        """
        self._look_after_server()
        for name, child in self._children.items():
            code = child.process.poll()
            if code is None:
                continue
            told = _cause(name, code, child.log)
            if not child.node.respawn or code in _FINAL_CODES:
                raise GraphError(told)
            now_s = time.monotonic()
            if len(child.recent) == MAX_RESTARTS and now_s - child.recent[0] < _RESTART_PERIOD_S:
                raise GraphError(f"{name} crashed more than {MAX_RESTARTS} times in {_RESTART_PERIOD_S:g} s: {told}")
            child.recent.append(now_s)
            child.restarts += 1
            child.log.close()
            remove_dead_segments()
            child.process, child.log = self._start(child.node, child.arguments)
            self._tell(f"{told}; it is started again")

    def end(self, node: str, reason: str) -> None:
        """End a node that is not as it should be; :meth:`check` starts it again."""
        child = self._children[node]
        if self.is_running(node):
            self._tell(f"{node} {reason}")
            child.process.send_signal(signal.SIGKILL)

    def is_running(self, node: str) -> bool:
        """Return False where a node has ended."""
        child = self._children[node]
        return child.is_started and child.process.poll() is None

    def forgive(self) -> None:
        """Count the crashes that end the graph anew, for who kills nodes on purpose."""
        for child in self._children.values():
            child.recent.clear()

    @property
    def pids(self) -> dict[str, int]:
        """Process id of each node; waits until all are started."""
        while not all(child.is_started for child in self._children.values()):
            self._look_after_server(_WAIT_S)
        return {name: child.process.pid for name, child in self._children.items()}

    @property
    def restarts(self) -> dict[str, int]:
        """How often each node that crashed was started again."""
        return {name: child.restarts for name, child in self._children.items() if child.restarts}

    def _start(self, node: NodeDescription, arguments: Sequence[str]) -> tuple[Process, IO[bytes]]:
        """Return a process that runs, or will as soon as it can, and the file that its standard error goes to."""
        log = tempfile.TemporaryFile()  # noqa: SIM115  It lives as long as the process.
        starts = sum(child.restarts for child in self._children.values())
        further = use_fresh_ports(Path(self._directory.name), starts) if starts else {}
        if self._server is None:
            return start_singly(node, arguments, log, further), log
        return self._server.start(node, arguments, log, further), log

    def _look_after_server(self, timeout_s: float = 0.0) -> None:
        """Hear the server; start the nodes without it where it could not start any.

        Raises:
            GraphError: it has ended, and its nodes with it.
        """
        if self._server is None:
            return
        self._server.listen(timeout_s)
        if self._server.failure is None:
            return
        if any(child.is_started for child in self._children.values()):
            raise GraphError(f"the process that starts the nodes is gone: {self._server.failure}")
        self._tell(f"every node is loaded by itself, which takes longer: {self._server.failure}")
        self._server.close()
        self._server = None
        for child in self._children.values():
            child.log.close()
            child.process, child.log = self._start(child.node, child.arguments)


def _wait(processes: list[Process], deadline_s: float) -> None:
    for process in processes:
        try:
            process.wait(max(0.0, deadline_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            continue


def _cause(name: str, code: int, log: IO[bytes]) -> str:
    """Return why a node ended: its own last line, unless it had no time to say one."""
    if code < 0:
        return f"{name} was ended by {signal.Signals(-code).name}"
    return last_line(log) or f"{name} ended with code '{code}' and said nothing"


def _write_line(text: str) -> None:
    sys.stderr.write(f"vli: {text}\n")
