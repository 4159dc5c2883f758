"""The nodes of a graph as child processes: started together, watched, stopped together."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import IO

import yaml

from vli_bringup.graph import NodeDescription
from vli_common.errors import VliError

_STOP_S = 5.0


class GraphError(VliError):
    """A node of the graph could not start, or failed."""


class NodeProcesses:
    """Context manager: all nodes run inside, none is left after.

    Args:
        nodes: see :func:`vli_bringup.graph.describe_graph`.
        parameter_file: for all nodes, in the form of config/vli.yaml.
    """

    def __init__(self, nodes: Sequence[NodeDescription], parameter_file: Path) -> None:
        self._nodes, self._parameter_file = nodes, parameter_file
        self._processes: dict[str, tuple[subprocess.Popen[bytes], IO[bytes]]] = {}
        self._directory = tempfile.TemporaryDirectory(prefix="vli-graph-")

    def __enter__(self) -> NodeProcesses:
        """Start every node."""
        for node in self._nodes:
            own = Path(self._directory.name) / f"{node.executable}.yaml"
            own.write_text(yaml.safe_dump({f"/**/{node.executable}": {"ros__parameters": dict(node.parameters)}}))
            files = [argument for path in (self._parameter_file, own) for argument in ("--params-file", str(path))]
            log = tempfile.TemporaryFile()
            command = [sys.executable, "-m", node.module, "--ros-args", *files]
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=log)
            self._processes[node.executable] = (process, log)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Stop every node: politely, then firmly."""
        for sign in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            running = [process for process, _ in self._processes.values() if process.poll() is None]
            for process in running:
                process.send_signal(sign)
            _wait(running, time.monotonic() + _STOP_S)
        for _, log in self._processes.values():
            log.close()
        self._directory.cleanup()

    def check(self) -> None:
        """Raise where a node has ended.

        Raises:
            GraphError: with the node's own last line.
        """
        for name, (process, log) in self._processes.items():
            code = process.poll()
            if code is not None:
                raise GraphError(_last_line(log) or f"{name} ended with code '{code}' and said nothing")

    @property
    def pids(self) -> dict[str, int]:
        """Process id of each node."""
        return {name: process.pid for name, (process, _) in self._processes.items()}


def _wait(processes: list[subprocess.Popen[bytes]], deadline_s: float) -> None:
    for process in processes:
        try:
            process.wait(max(0.0, deadline_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            continue


def _last_line(log: IO[bytes]) -> str:
    log.seek(0)
    lines = [line for line in log.read().decode(errors="replace").splitlines() if line.strip()]
    return lines[-1].strip() if lines else ""
