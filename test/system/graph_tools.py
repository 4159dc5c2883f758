"""What the tests of the node graph share: waiting for what it says, and a graph over the demo bag."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from vli_bringup.graph import NodeDescription, Playback, describe_graph
from vli_bringup.listener import GraphListener
from vli_bringup.processes import NodeProcesses
from vli_common.status import NodeState

NODES = [node.executable for node in describe_graph(Path("none"))]
START_S = 240.0
"""What a start may take on a busy machine that compiles kernels."""


def wait(
    listener: GraphListener,
    condition: Callable[[], bool],
    timeout_s: float = START_S,
    processes: NodeProcesses | None = None,
) -> float:
    """Spin until a condition holds; return how long that took. ``processes`` are kept alive meanwhile."""
    begin_s = time.monotonic()
    while not condition():
        assert time.monotonic() < begin_s + timeout_s, "\n".join(map(str, listener.statuses.values()))
        if processes is not None:
            processes.check()
        listener.spin()
    return time.monotonic() - begin_s


def command(executable: str, *parameters: str) -> list[str]:
    """Return how a node is started singly, with parameters ``name:=value``."""
    (node,) = [node for node in describe_graph(Path("none")) if node.executable == executable]
    arguments = [argument for parameter in parameters for argument in ("-p", parameter)]
    return [sys.executable, "-m", node.module, "--ros-args", *arguments]


def demo_graph(
    demo: Path, own: Mapping[str, Mapping[str, Any]] | None = None, rate: float = 0.5, audience: str | None = None
) -> list[NodeDescription]:
    """Return the graph over the demo bag; every node is started again when it crashes, the driver too.

    Args:
        demo: directory of bag and calibration.
        own: node → further parameters.
        rate: bag seconds a second; below 1, so that a busy machine keeps the pace.
        audience: a node outside the graph that the driver waits for.
    """
    playback = Playback(demo / "bag", rate)
    nodes = describe_graph(demo / "calibration.yaml", playback=playback, audience=audience)
    further = own or {}
    return [replace(node, parameters={**node.parameters, **further.get(node.executable, {})}, respawn=True) for node in nodes]


def text(listener: GraphListener, node: str, name: str) -> str:
    """Return a value out of the newest status of a node, empty where it has none of this name."""
    status = listener.statuses.get(node)
    return status.values.get(name, "") if status else ""


def is_linked(listener: GraphListener, newer_than_ns: int = 0) -> bool:
    """Return True where every node works, hears all it listens to, and is of one session.

    Args:
        listener: in the graph.
        newer_than_ns: only what was said later counts.
    """
    statuses = [listener.statuses.get(name) for name in NODES]
    known = [status for status in statuses if status is not None and status.stamp_ns > newer_than_ns]
    return (
        len(known) == len(NODES)
        and all(status.state in (NodeState.READY, NodeState.FINISHED) for status in known)
        and not any(status.values["unmatched"] for status in known)
        and len({status.values["session"] for status in known}) == 1
    )


def replay(demo: Path, out: Path, *options: str, bag: Path | None = None) -> subprocess.Popen[bytes]:
    """Start ``vli replay`` of the demo bag, or another of that scanner, slowly."""
    arguments = [
        "replay",
        str(bag or demo / "bag"),
        "--calib",
        str(demo / "calibration.yaml"),
        "--out",
        str(out),
        "--rate",
        "0.3",
    ]
    command_line = [sys.executable, "-m", "vli_bringup.cli", *arguments, *options]
    return subprocess.Popen(command_line, stderr=subprocess.PIPE, stdout=subprocess.PIPE)


def pid_of(process: subprocess.Popen[bytes], name: str) -> int:
    """Return the process id of a node that a command has started, by way of the process that starts them; 0 while it is away."""
    parents: dict[int, tuple[str, int]] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            head, _, rest = path.read_text().rpartition(")")
            parents[int(path.parent.name)] = head.partition("(")[2], int(rest.split()[1])
    server = [pid for pid, (_, parent) in parents.items() if parent == process.pid]
    return next((pid for pid, (said, parent) in parents.items() if parent in server and said == name[:15]), 0)
