"""Waiting for what other threads and processes do."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

PATIENCE_S = 20.0
_STEP_S = 0.01


def wait(condition: Callable[[], object], timeout_s: float = PATIENCE_S) -> None:
    """Return once a condition holds; fail where it does not in time."""
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(_STEP_S)


def is_running(pid: int | str) -> bool:
    """Return False for a process that has ended, whether or not somebody has taken note."""
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False
