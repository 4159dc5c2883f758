"""What the middleware leaves behind."""

from __future__ import annotations

import fcntl
from pathlib import Path

from vli_common.node.transport import remove_dead_segments


def test_shared_memory_of_the_dead_is_removed_and_that_of_the_living_is_not(tmp_path: Path) -> None:
    dead, living, port = "fastrtps_00fd803ff25ece42", "fastrtps_15f9d246cd446c78", "fastrtps_port7400"
    for name in (dead, living, port):
        (tmp_path / name).write_bytes(b"memory")
        (tmp_path / f"{name}_el").touch()
    with (tmp_path / f"{living}_el").open("r+b") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert remove_dead_segments(tmp_path) == 1
    assert {path.name for path in tmp_path.iterdir()} == {living, f"{living}_el", port, f"{port}_el"}
    assert remove_dead_segments(tmp_path / "none") == 0
