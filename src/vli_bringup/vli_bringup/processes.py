"""The nodes of a graph as child processes: started together, watched, stopped together."""

from __future__ import annotations

import os
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
from vli_common.errors import VliError
from vli_common.node.main import STOP_WITH_PARENT
from vli_common.node.transport import remove_dead_segments

MAX_RESTARTS = 3
"""Of one node within a minute."""
_RESTART_PERIOD_S = 60.0
_FINAL_CODES = (0, 2)
"""Of :func:`vli_common.node.run_node`: told to stop, could not start. It would be the same again."""
_STOP_S = 5.0


class GraphError(VliError):
    """A node of the graph could not start, or failed."""


@dataclass
class _Child:
    """A node, its process of now, and when its predecessors were started in its place."""

    node: NodeDescription
    arguments: list[str]
    process: subprocess.Popen[bytes]
    log: IO[bytes]
    restarts: int = 0
    recent: deque[float] = field(default_factory=lambda: deque(maxlen=MAX_RESTARTS))


class NodeProcesses:
    """Context manager: all nodes run inside, none is left after.

    A node that crashes is started again by :meth:`check`, three times a minute at most, while the others go on; one that cannot
    start, or was told to stop, is not.

    Args:
        nodes: see :func:`vli_bringup.graph.describe_graph`.
        parameter_file: for all nodes, in the form of config/vli.yaml.
        tell: gets one line for every node that is started again; writes it on standard error unless given.
    """

    def __init__(self, nodes: Sequence[NodeDescription], parameter_file: Path, tell: Callable[[str], None] | None = None) -> None:
        self._nodes, self._parameter_file = nodes, parameter_file
        self._tell = tell or _write_line
        self._children: dict[str, _Child] = {}
        self._directory = tempfile.TemporaryDirectory(prefix="vli-graph-")

    def __enter__(self) -> NodeProcesses:
        """Start every node."""
        for node in self._nodes:
            own = Path(self._directory.name) / f"{node.executable}.yaml"
            own.write_text(yaml.safe_dump({f"/**/{node.executable}": {"ros__parameters": dict(node.parameters)}}))
            files = [argument for path in (self._parameter_file, own) for argument in ("--params-file", str(path))]
            arguments = [sys.executable, "-m", node.module, "--ros-args", *files]
            self._children[node.executable] = _Child(node, arguments, *_start(arguments))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Stop every node: politely, then firmly."""
        for sign in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            running = [child.process for child in self._children.values() if child.process.poll() is None]
            for process in running:
                process.send_signal(sign)
            _wait(running, time.monotonic() + _STOP_S)
        for child in self._children.values():
            child.log.close()
        remove_dead_segments()
        self._directory.cleanup()

    def check(self) -> None:
        """Start again what has crashed.

        Raises:
            GraphError: a node has ended for good; with its own last line.
        """
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
            child.process, child.log = _start(child.arguments)
            self._tell(f"{told}; it is started again")

    def forgive(self) -> None:
        """Count the crashes that end the graph anew, for who kills nodes on purpose."""
        for child in self._children.values():
            child.recent.clear()

    @property
    def pids(self) -> dict[str, int]:
        """Process id of each node."""
        return {name: child.process.pid for name, child in self._children.items()}

    @property
    def restarts(self) -> dict[str, int]:
        """How often each node that crashed was started again."""
        return {name: child.restarts for name, child in self._children.items() if child.restarts}


def _start(arguments: Sequence[str]) -> tuple[subprocess.Popen[bytes], IO[bytes]]:
    """Return a running process, and the file that its standard error goes to."""
    log = tempfile.TemporaryFile()  # noqa: SIM115  It lives as long as the process.
    environment = {**os.environ, STOP_WITH_PARENT: str(os.getpid())}
    # A session of its own: Ctrl-C is for the command, which has things to ask of the nodes before it stops them.
    process = subprocess.Popen(
        arguments, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=log, env=environment, start_new_session=True
    )
    return process, log


def _wait(processes: list[subprocess.Popen[bytes]], deadline_s: float) -> None:
    for process in processes:
        try:
            process.wait(max(0.0, deadline_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            continue


def _cause(name: str, code: int, log: IO[bytes]) -> str:
    """Return why a node ended: its own last line, unless it had no time to say one."""
    if code < 0:
        return f"{name} was ended by {signal.Signals(-code).name}"
    return _last_line(log) or f"{name} ended with code '{code}' and said nothing"


def _last_line(log: IO[bytes]) -> str:
    log.seek(0)
    lines = [line for line in log.read().decode(errors="replace").splitlines() if line.strip()]
    return lines[-1].strip() if lines else ""


def _write_line(text: str) -> None:
    sys.stderr.write(f"vli: {text}\n")
