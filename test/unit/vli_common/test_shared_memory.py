"""Shared memory of the dead is removed, and that of the living is not."""

from __future__ import annotations

import fcntl
import mmap
import os
from pathlib import Path

from vli_common.node.shared_memory import remove_dead_segments

AN_HOUR_AGO = (1.0, 1.0)


def names(directory: Path) -> set[str]:
    return {path.name for path in directory.iterdir()}


def test_segments_go_whose_owner_holds_no_lock_any_more(tmp_path: Path) -> None:
    dead, living = "fastrtps_00fd803ff25ece42", "fastrtps_15f9d246cd446c78"
    for name in (dead, living, "fastrtps_of_others", "something"):
        (tmp_path / name).write_bytes(b"memory")
        (tmp_path / f"{name}_el").touch()
    before = names(tmp_path)
    with (tmp_path / f"{living}_el").open("r+b") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert remove_dead_segments(tmp_path) == 1
    assert names(tmp_path) == before - {dead, f"{dead}_el"}
    assert remove_dead_segments(tmp_path / "none") == 0


def test_ports_go_that_nobody_listens_on_writes_to_or_is_about_to_use(tmp_path: Path) -> None:
    for number in range(5):
        (tmp_path / f"fastrtps_port{number}").write_bytes(b"memory")
        (tmp_path / f"sem.fastrtps_port{number}_mutex").touch()
        if number != 4:
            os.utime(tmp_path / f"fastrtps_port{number}", AN_HOUR_AGO)
    for name in ("fastrtps_port0_el", "fastrtps_port1_el", "fastrtps_port2_sl"):
        (tmp_path / name).touch()
    before = names(tmp_path)
    with (
        (tmp_path / "fastrtps_port1_el").open("r+b") as heard,
        (tmp_path / "fastrtps_port2_sl").open("r+b") as shared,
        (tmp_path / "fastrtps_port3").open("r+b") as written,
        mmap.mmap(written.fileno(), 0),
    ):
        fcntl.flock(heard, fcntl.LOCK_EX)
        fcntl.flock(shared, fcntl.LOCK_SH)
        assert remove_dead_segments(tmp_path) == 1
    assert before - names(tmp_path) == {"fastrtps_port0", "fastrtps_port0_el", "sem.fastrtps_port0_mutex"}
