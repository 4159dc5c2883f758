"""Signals that come while a node is still being loaded."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from vli_common.stop_signals import held_back

_MODULE = """
import os, signal
import vli_common.stop_signals as stop_signals
for number in (signal.SIGINT, signal.SIGTERM):
    os.kill(os.getpid(), number)
print(stop_signals.STOP.is_set())
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    nodes = tmp_path / "robot" / "nodes"
    nodes.mkdir(parents=True)
    (tmp_path / "robot" / "__init__.py").touch()
    (nodes / "__init__.py").write_text("from vli_common.stop_signals import take_over_in_nodes\ntake_over_in_nodes(__name__)\n")
    (nodes / "some_node.py").write_text(_MODULE)
    return tmp_path


def run(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], cwd=directory, capture_output=True, text=True, check=False)


def test_a_node_that_is_being_loaded_notes_the_signal_and_goes_on(package: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "robot.nodes.some_node"], cwd=package, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "True\n", "")


def test_a_process_that_only_imports_a_node_keeps_its_signals(package: Path) -> None:
    done = run(package, "-c", "import robot.nodes.some_node")
    assert done.returncode == -signal.SIGINT


def test_a_signal_that_comes_before_python_is_there_waits_for_the_handler(package: Path) -> None:
    (package / "robot" / "nodes" / "waiting_node.py").write_text(
        "from vli_common.stop_signals import STOP\nprint(STOP.wait(60))\n"
    )
    with held_back():
        process = subprocess.Popen(
            [sys.executable, "-m", "robot.nodes.waiting_node"], cwd=package, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
    process.send_signal(signal.SIGTERM)
    assert process.communicate() == (b"True\n", b"")
    assert process.returncode == 0


def test_who_holds_signals_back_gets_them_afterwards() -> None:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    with held_back():
        assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) >= {signal.SIGINT, signal.SIGTERM}
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before
