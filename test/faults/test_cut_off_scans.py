"""What was scanned before a node failed for good, or before a session ended, is in the results. All with real processes."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from bags import write_bag
from graph_tools import START_S, pid_of, replay, wait
from streams import Span, Stream, change, shift

from vli_bringup.listener import GraphListener
from vli_bringup.processes import MAX_RESTARTS
from vli_bringup.tum import read_tum
from vli_common import ply
from vli_common.calibration import load_calibration
from vli_common.types import NANOSECONDS
from vli_mapping.map_file import load_map

pytestmark = pytest.mark.graph

_MAPPING, _BACK_END = "mapping_node", "backend_node"
JUMP_S = 2.5


def test_a_node_that_crashes_again_and_again_ends_the_replay_and_costs_nothing_that_was_scanned(
    demo: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    process = replay(demo, out)
    with GraphListener(load_calibration(demo / "calibration.yaml")) as listener:
        wait(listener, lambda: listener.value(_MAPPING, "points") > 500)
    killed: set[int] = set()
    deadline_s = time.monotonic() + START_S
    while len(killed) <= MAX_RESTARTS and time.monotonic() < deadline_s:
        if (pid := pid_of(process, "demux_node")) and pid not in killed:
            killed.add(pid)
            os.kill(pid, signal.SIGKILL)
        time.sleep(0.1)
    said, told = process.communicate(timeout=START_S)
    errors = told.decode()
    assert process.returncode == 2, errors
    assert f"demux_node crashed more than {MAX_RESTARTS} times in 60 s" in errors
    assert "what had been scanned by then is written" in errors
    assert "Traceback" not in errors
    summary = json.loads((out / "summary.json").read_text())
    assert summary["failure"].startswith("demux_node crashed")
    assert summary["points"] > 500
    assert f"{summary['points']} map points; results in".encode() in said
    assert (out / "map.vli").exists()
    assert len((out / "trajectory.tum").read_text().splitlines()) == summary["frames_with_pose"] > 10
    assert not list(out.glob("autosave*"))


def test_a_back_end_that_crashes_costs_neither_path_nor_map_of_before(demo: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = replay(demo, out, "--autosave", "1")
    with GraphListener(load_calibration(demo / "calibration.yaml")) as listener:
        wait(listener, lambda: listener.value(_MAPPING, "points") > 3000)
        session = listener.value(_BACK_END, "session")
        pid = pid_of(process, _BACK_END)
        # 0 is this process and its children.
        assert pid
        os.kill(pid, signal.SIGKILL)
        wait(listener, lambda: listener.value(_MAPPING, "session") > session and listener.value(_MAPPING, "points") > 500)
    said, told = process.communicate(timeout=START_S)
    errors = told.decode()
    assert process.returncode == 0, errors
    assert f"what was scanned in it is in '{out / 'session-1'}'; join with: vli merge" in errors
    before, after = (read_tum(path / "trajectory.tum").stamps_ns for path in (out / "session-1", out))
    assert before[-1] < after[0]
    assert min(len(before), len(after)) > 10
    for path, points in ((out / "session-1", 3000), (out, 500)):
        assert len(load_map(path / "map.vli")) > points
        assert len(ply.read_cloud(path / "map.ply").points) > points
    assert f"{len(before) + len(after)} poses of".encode() in said
    assert not list(out.glob("autosave*"))


def test_f13_a_clock_that_jumps_costs_neither_path_nor_map_of_before(demo: Path, first_part: Stream, tmp_path: Path) -> None:
    jumped = change(first_part, Span(JUMP_S).mask(first_part), lambda item: shift(item, -10 * NANOSECONDS))
    out = tmp_path / "out"
    process = replay(demo, out, bag=write_bag(tmp_path / "bag", jumped))
    _, told = process.communicate(timeout=START_S)
    assert process.returncode == 0, told.decode()
    assert f"what was scanned in it is in '{out / 'session-1'}'".encode() in told
    last = read_tum(out / "trajectory.tum").stamps_ns
    assert np.all(np.diff(last) > 0)
    assert last[0] < read_tum(out / "session-1" / "trajectory.tum").stamps_ns[0]
    for path in (out, out / "session-1"):
        assert len(read_tum(path / "trajectory_final.tum")) > 20
        assert len(ply.read_cloud(path / "map.ply").points) > 3000
        assert len(load_map(path / "map.vli")) > 3000


def test_a_replay_of_half_a_bag_says_what_was_lost(demo: Path, tmp_path: Path) -> None:
    whole = next((demo / "bag").glob("*.mcap")).read_bytes()
    half = tmp_path / "half.mcap"
    half.write_bytes(whole[: len(whole) // 3])
    process = replay(demo, tmp_path / "out", bag=half)
    _, told = process.communicate(timeout=START_S)
    assert process.returncode in (0, 1), told.decode()
    assert sum("warning" in line and "half.mcap" in line for line in told.decode().splitlines()) == 1
