"""Signals that come while a node is still being loaded."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from vli_common.stop_signals import held_back

_MODULE = """
import os, signal, sys
import vli_common.stop_signals as stop_signals
number = signal.Signals[os.environ["SENT"]]
if "TAKEN" in os.environ:
    stop_signals.take_over()
os.kill(os.getpid(), number)
print(stop_signals.STOP.is_set())
sys.exit(7)
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    nodes = tmp_path / "robot" / "nodes"
    nodes.mkdir(parents=True)
    (tmp_path / "robot" / "__init__.py").touch()
    (nodes / "__init__.py").write_text("from vli_common.stop_signals import take_over_in_nodes\ntake_over_in_nodes(__name__)\n")
    (nodes / "some_node.py").write_text(_MODULE)
    return tmp_path


def run(directory: Path, *arguments: str, **environment: str) -> tuple[int, str, str]:
    done = subprocess.run(
        [sys.executable, *arguments], cwd=directory, env=os.environ | environment, capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("sent", ["SIGINT", "SIGTERM"])
def test_a_node_that_is_being_loaded_ends_at_once_and_in_silence(package: Path, sent: str) -> None:
    assert run(package, "-m", "robot.nodes.some_node", SENT=sent) == (0, "", "")


@pytest.mark.parametrize("sent", ["SIGINT", "SIGTERM"])
def test_a_node_that_runs_notes_the_signal_and_goes_on(package: Path, sent: str) -> None:
    assert run(package, "-m", "robot.nodes.some_node", SENT=sent, TAKEN="yes") == (7, "True\n", "")


def test_a_process_that_only_imports_a_node_keeps_its_signals(package: Path) -> None:
    # Not SIGINT, which a shell has its background jobs ignore, and their children with them.
    code, _, _ = run(package, "-c", "import robot.nodes.some_node", SENT="SIGTERM")
    assert code == -signal.SIGTERM


def test_a_signal_that_comes_before_python_is_there_waits_for_the_handler(package: Path) -> None:
    (package / "robot" / "nodes" / "waiting_node.py").write_text(
        "from vli_common.stop_signals import STOP\nprint(STOP.wait(60))\nraise SystemExit(7)\n"
    )
    with held_back():
        process = subprocess.Popen(
            [sys.executable, "-m", "robot.nodes.waiting_node"], cwd=package, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
    process.send_signal(signal.SIGTERM)
    assert process.communicate() == (b"", b"")
    assert process.returncode == 0


def test_who_holds_signals_back_gets_them_afterwards() -> None:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    with held_back():
        assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) >= {signal.SIGINT, signal.SIGTERM}
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before
