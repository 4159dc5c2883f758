"""The server that forks nodes: what it starts is like a process of its own, and nothing is left of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from patience import is_running

from vli_bringup.graph import NodeDescription
from vli_bringup.node_server import load, threads
from vli_bringup.node_starter import NodeServer, ServedProcess, last_line
from vli_bringup.processes import GraphError, NodeProcesses
from vli_common.errors import VliError

_START_S = 120.0
_NODE = """
import os, signal, sys, time, {imports}
from vli_common.stop_signals import STOP, take_over
def main():
    sys.stderr.write(f"{{sys.argv[1:]}} {{os.getsid(0) == os.getpid()}} {{os.environ.get('FURTHER')}} {{sys.stdin.read()!r}}\\n")
    sys.stderr.flush()
    {body}
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a directory that processes import packages from."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def write_node(directory: Path, name: str, body: str, imports: str = "json") -> NodeDescription:
    """Write a package with one node that is no ROS node."""
    nodes = directory / f"package_of_{name}" / "nodes"
    nodes.mkdir(parents=True)
    (nodes / f"{name}.py").write_text(_NODE.format(body=body, imports=imports))
    (nodes.parent / "warm_up.py").write_text("def warm_up(): pass\n")
    return NodeDescription(nodes.parent.name, name)


def wait_for(process: ServedProcess, server: NodeServer) -> None:
    """Return when a process was started."""
    deadline_s = time.monotonic() + _START_S
    while process.started_pid is None:
        assert server.failure is None, server.failure
        assert time.monotonic() < deadline_s
        server.listen(0.1)


@pytest.fixture
def sleeper(package: Path) -> NodeDescription:
    return write_node(package, "sleeping_node", "signal.signal(signal.SIGINT, signal.SIG_DFL); time.sleep(60)")


@pytest.fixture
def server(sleeper: NodeDescription) -> Iterator[NodeServer]:
    item = NodeServer([sleeper.module])
    yield item
    item.close()


def test_a_forked_node_has_its_arguments_its_session_its_environment_its_name_and_nothing_to_read(
    server: NodeServer, sleeper: NodeDescription
) -> None:
    with tempfile.TemporaryFile() as log:
        process = server.start(sleeper, ["--ros-args", "x"], log, {"FURTHER": "y"})
        wait_for(process, server)
        deadline_s = time.monotonic() + _START_S
        while not (said := last_line(log)):
            assert time.monotonic() < deadline_s
        assert said == "['--ros-args', 'x'] True y ''"
        assert Path(f"/proc/{process.pid}/comm").read_text() == "sleeping_node\n"
        assert process.poll() is None
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.1)
        process.send_signal(signal.SIGKILL)
        assert process.wait(5.0) == -signal.SIGKILL
        process.send_signal(signal.SIGKILL)
    server.close()
    assert not Path(f"/proc/{server.pid}").exists()


def test_a_death_is_known_as_soon_as_the_process_is_gone(server: NodeServer, sleeper: NodeDescription) -> None:
    with tempfile.TemporaryFile() as log:
        for _ in range(20):
            process = server.start(sleeper, [], log, {})
            wait_for(process, server)
            os.kill(process.pid, signal.SIGKILL)
            while is_running(process.pid):
                pass
            assert process.poll() == -signal.SIGKILL


def test_a_server_that_is_closed_early_starts_nothing(package: Path) -> None:
    mark = package / "started"
    node = write_node(package, "marking_node", f"open({str(mark)!r}, 'w')")
    server = NodeServer([node.module])
    with tempfile.TemporaryFile() as log:
        process = server.start(node, [], log, {})
        server.close()
    time.sleep(0.5)
    assert not mark.exists()
    with pytest.raises(ProcessLookupError):
        process.pid  # noqa: B018


def test_libraries_with_threads_are_not_forked(package: Path) -> None:
    node = write_node(package, "threaded_node", "pass")
    warm_up = package / node.package / "warm_up.py"
    warm_up.write_text(
        "import threading\ndef warm_up():\n    threading.Thread(target=threading.Event().wait, args=(2,), daemon=True).start()\n"
    )
    assert threads() >= 1
    with pytest.raises(VliError, match="the libraries have '1' threads that a fork would lose"):
        load([node.module])


def test_nodes_are_loaded_one_by_one_where_the_server_cannot(package: Path) -> None:
    node = write_node(package, "refusing_node", "take_over(); sys.exit(not STOP.wait(60))")
    (package / node.package / "warm_up.py").write_text("raise ValueError('not here')\n")
    (package / node.package / "nodes" / "refusing_node.py").open("a").write("\nif __name__ == '__main__': main()\n")
    (package / "vli.yaml").write_text("{}")
    told: list[str] = []
    with NodeProcesses([node], package / "vli.yaml", told.append) as processes:
        (pid,) = processes.pids.values()
        assert told == ["every node is loaded by itself, which takes longer: ValueError: not here"]
        assert Path(f"/proc/{pid}").exists()
        processes.check()
    assert not Path(f"/proc/{pid}").exists()


def test_the_end_of_the_server_is_told(package: Path, sleeper: NodeDescription) -> None:
    (package / "vli.yaml").write_text("{}")
    with NodeProcesses([sleeper], package / "vli.yaml") as processes:
        (pid,) = processes.pids.values()
        os.kill(int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1]), signal.SIGKILL)
        with pytest.raises(GraphError, match="the process that starts the nodes is gone: ended with code '-9'"):  # noqa: PT012
            while True:
                processes.check()


def test_a_node_that_is_not_as_it_should_be_is_ended_and_started_again(package: Path, sleeper: NodeDescription) -> None:
    (package / "vli.yaml").write_text("{}")
    told: list[str] = []
    with NodeProcesses([sleeper], package / "vli.yaml", told.append) as processes:
        (before,) = processes.pids.values()
        processes.end(sleeper.executable, "is cut off")
        while not processes.restarts:
            processes.check()
            time.sleep(0.02)
        (after,) = processes.pids.values()
        assert after != before
    name = sleeper.executable
    assert told == [f"{name} is cut off", f"{name} was ended by SIGKILL; it is started again"]
