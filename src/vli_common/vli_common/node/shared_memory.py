"""What killed processes leave of Fast DDS in ``/dev/shm``, and its removal: what ``fastdds shm clean`` removes, and ports.

A process has a segment ``fastrtps_ID`` for what it sends, 16 MB, and a lock on ``fastrtps_ID_el`` while it lives. It listens on
ports, ``fastrtps_portN`` of 52 kB, with a lock on ``…_el`` or, where others may listen too, ``…_sl``, and a semaphore. Who uses a
port last removes it; a process that was killed is counted for ever.
"""

from __future__ import annotations

import fcntl
import re
import time
from collections.abc import Iterable
from pathlib import Path

DIRECTORY = Path("/dev/shm")
_SEGMENT_LOCK = re.compile(r"fastrtps_[0-9a-f]{16}_el")
_PORT = re.compile(r"fastrtps_port\d+")
_LOCKS = ("_el", "_sl")
_YOUNG_S = 0.5
"""A port that is being made has no user yet."""


def remove_dead_segments(directory: Path = DIRECTORY) -> int:
    """Remove segments whose owner is dead, and ports that nobody uses; return how many."""
    segments = [
        lock.with_name(lock.name.removesuffix("_el"))
        for lock in directory.glob("fastrtps_*_el")
        if _SEGMENT_LOCK.fullmatch(lock.name) and not _is_locked(lock)
    ]
    ports = _dead_ports(directory)
    for path in (*segments, *ports):
        for name in (path.name, *(f"{path.name}{lock}" for lock in _LOCKS), f"sem.{path.name}_mutex"):
            path.with_name(name).unlink(missing_ok=True)
    return len(segments) + len(ports)


def _dead_ports(directory: Path) -> list[Path]:
    """Return the ports that nobody listens on and no process has mapped, one that writes to it neither."""
    oldest_s = time.time() - _YOUNG_S
    silent = [
        port
        for port in directory.glob("fastrtps_port*")
        if _PORT.fullmatch(port.name)
        and not any(_is_locked(port.with_name(port.name + lock)) for lock in _LOCKS)
        and _made_s(port) < oldest_s
    ]
    mapped = _mapped(silent) if silent else set()
    return [port for port in silent if port not in mapped]


def _mapped(paths: Iterable[Path]) -> set[Path]:
    """Return those of some files that a process has mapped, as far as we may look."""
    wanted = {str(path) for path in paths}
    found: set[str] = set()
    for maps in Path("/proc").glob("[0-9]*/maps"):
        try:
            lines = maps.read_text(errors="replace").splitlines()
        except OSError:
            # It has ended, or is another user's.
            continue
        found |= wanted.intersection(line.rpartition(" ")[2] for line in lines)
    return {Path(path) for path in found}


def _made_s(path: Path) -> float:
    """Return when a file was made; for one that is gone, a time to come."""
    try:
        return path.stat().st_mtime
    except OSError:
        return float("inf")


def _is_locked(path: Path) -> bool:
    """Return True where a process holds the lock, or it is not ours to ask; False where there is no such file."""
    try:
        with path.open("r+b") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False
