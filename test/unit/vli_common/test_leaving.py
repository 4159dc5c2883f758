"""The end of a process comes in time, with its own exit code, whatever native code does."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

_HANG = "ctypes.PyDLL(None).sleep(60)"
"""In native code, and without letting anybody else have the interpreter."""
_LEAVING = f"""
import ctypes, sys
from vli_common.node.leaving import leave_after
leave_after(0.2, int(sys.argv[1]))
{_HANG}
"""
_NODE = f"""
import ctypes, sys
from pathlib import Path
from vli_common.node import VliNode, run_node
from vli_common.stop_signals import STOP

def be_told_to_stop():
    STOP.set()

def fail():
    raise ZeroDivisionError("of a callback")

class HangingNode(VliNode):
    def __init__(self):
        super().__init__("hanging_node", dict(), needs_calibration=False)
        self.every(0.05, {{action}})
    def close(self):
        closed = super().close()
        Path({{mark!r}}).write_text("saved")
        return closed
    def destroy_node(self):
        {_HANG}

run_node(HangingNode)
"""


def run(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a program; one that hangs for good ends with a code of its own only."""
    return subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("code", [0, 1, 2])
def test_a_process_that_hangs_with_the_interpreter_in_its_hands_ends_with_the_code_that_was_set(code: int) -> None:
    done = run(f"{_LEAVING}\nsys.exit(99)", str(code))
    assert (done.returncode, done.stdout, done.stderr) == (code, "", "")


@pytest.mark.parametrize(("action", "code"), [("be_told_to_stop", 0), ("fail", 1)])
def test_a_node_whose_middleware_hangs_at_the_end_has_saved_what_it_has_and_keeps_its_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, action: str, code: int
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    mark = tmp_path / "mark"
    done = run(_NODE.format(action=action, mark=str(mark)) + "\nsys.exit(99)")
    assert done.returncode == code, done.stderr
    assert mark.read_text() == "saved"
    assert "Traceback" not in done.stderr
    assert ("hanging_node failed: ZeroDivisionError: of a callback" in done.stderr) == bool(code)
