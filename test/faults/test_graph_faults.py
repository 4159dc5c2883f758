"""Faults F22, F23, F27, F30: nodes that die, hang, come late, are too slow, or are told to stop. All with real processes."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from graph_tools import NODES, demo_graph, is_linked, replay, text, wait

from vli_bringup.graph import NodeDescription
from vli_bringup.listener import LISTENER, GraphListener
from vli_bringup.processes import NodeProcesses
from vli_bringup.watch import GraphWatch
from vli_common.calibration import load_calibration
from vli_common.messages import cloud_from_message
from vli_common.node.transport import message_type, quality
from vli_common.topics import MAP
from vli_mapping.map_file import load_map

pytestmark = pytest.mark.graph

_MAPPING, _BACK_END = "mapping_node", "backend_node"
_LOOP = {"driver_node": {"loop": True}}


@pytest.fixture
def listener(demo: Path) -> Iterator[GraphListener]:
    with GraphListener(load_calibration(demo / "calibration.yaml")) as item:
        yield item


def kill(processes: NodeProcesses, name: str) -> int:
    """Kill a node at once; return when, by the wall clock."""
    os.kill(processes.pids[name], signal.SIGKILL)
    return time.time_ns()


def is_back(listener: GraphListener, name: str, killed_ns: int) -> bool:
    """Return True where a node killed then runs again and the whole graph is linked."""
    return int(text(listener, name, "started_ns") or 0) > killed_ns and is_linked(listener, killed_ns)


def test_any_node_killed_and_started_again_is_linked_again_while_the_others_go_on(
    demo: Path, parameter_file: Path, listener: GraphListener
) -> None:
    told: list[str] = []
    with NodeProcesses(demo_graph(demo, _LOOP), parameter_file, told.append) as processes:
        wait(listener, lambda: listener.value("driver_node", "position_ns") > 0, processes=processes)
        for name in NODES:
            others = {other: pid for other, pid in processes.pids.items() if other != name}
            killed_ns = kill(processes, name)
            wait(listener, lambda name=name, ns=killed_ns: is_back(listener, name, ns), processes=processes)
            assert {other: processes.pids[other] for other in others} == others
        assert processes.restarts == dict.fromkeys(NODES, 1)
        assert len(told) == len(NODES)
        wait(listener, lambda: text(listener, _BACK_END, "tracking") == "TRACKING", processes=processes)
        wait(listener, lambda: listener.value(_MAPPING, "points") > 0, processes=processes)


@pytest.mark.slow
def test_a_node_that_hangs_is_ended_and_started_again(demo: Path, parameter_file: Path, listener: GraphListener) -> None:
    told: list[str] = []
    with NodeProcesses(demo_graph(demo, _LOOP), parameter_file, told.append) as processes:
        watch = GraphWatch(processes)
        wait(listener, lambda: listener.value("driver_node", "position_ns") > 0, processes=processes)
        os.kill(processes.pids["demux_node"], signal.SIGSTOP)
        stopped_ns = time.time_ns()

        def healed() -> bool:
            watch.look(listener.statuses, listener.heard_s)
            return is_back(listener, "demux_node", stopped_ns)

        wait(listener, healed, 90.0, processes)
        assert processes.restarts == {"demux_node": 1}
        assert re.fullmatch(r"demux_node (has said nothing for \d+ s|is cut off: .*)", told[0])
        assert told[1:] == ["demux_node was ended by SIGKILL; it is started again"]


@pytest.mark.slow
def test_a_mapping_node_started_again_goes_on_with_the_map_it_had_saved(
    demo: Path, tmp_path: Path, parameter_file: Path, listener: GraphListener
) -> None:
    saved = tmp_path / "autosave.vli"
    nodes = demo_graph(demo, {_MAPPING: {"autosave_s": 0.5, "autosave_path": str(saved)}}, rate=0.15)
    with NodeProcesses(nodes, parameter_file) as processes:
        wait(listener, lambda: listener.value(_MAPPING, "points") > 5000 and saved.exists(), processes=processes)
        session = listener.value(_MAPPING, "session")
        killed_ns = kill(processes, _MAPPING)
        reloaded = len(load_map(saved))
        wait(listener, lambda: is_back(listener, _MAPPING, killed_ns), processes=processes)
        wait(listener, lambda: listener.value(_MAPPING, "points") >= reloaded, 20.0, processes)
        wait(listener, lambda: listener.value(_MAPPING, "points") > reloaded + 500, 60.0, processes)
        assert listener.value(_MAPPING, "session") == session


@pytest.mark.slow
def test_a_back_end_started_again_begins_a_session_since_its_frame_is_another(
    demo: Path, tmp_path: Path, parameter_file: Path, listener: GraphListener
) -> None:
    saved = tmp_path / "autosave.vli"
    nodes = demo_graph(demo, {**_LOOP, _MAPPING: {"autosave_s": 0.5, "autosave_path": str(saved)}}, rate=0.3)
    with NodeProcesses(nodes, parameter_file) as processes:
        wait(listener, lambda: listener.value(_MAPPING, "points") > 1000 and saved.exists(), processes=processes)
        session = listener.value(_MAPPING, "session")
        killed_ns = kill(processes, _BACK_END)
        wait(listener, lambda: is_back(listener, _BACK_END, killed_ns), processes=processes)
        wait(listener, lambda: all(listener.value(name, "session") > session for name in NODES), 20.0, processes)


@pytest.mark.slow
def test_who_starts_late_gets_the_calibration_and_the_full_map(demo: Path, parameter_file: Path, listener: GraphListener) -> None:
    *early, mapping = demo_graph(demo, {"driver_node": {"wait_for": "demux_node,frontend_node", "loop": True}})
    with NodeProcesses(early, parameter_file) as graph:
        wait(listener, lambda: text(listener, _BACK_END, "tracking") == "TRACKING", processes=graph)
        with NodeProcesses([mapping], parameter_file) as late:
            wait(listener, lambda: listener.value(_MAPPING, "points") > 500, processes=late)
            clouds: list[int] = []

            def on_map(message: object) -> None:
                clouds.append(len(cloud_from_message(message).points))

            listener.node.create_subscription(message_type(MAP), MAP.name, on_map, quality(MAP))
            wait(listener, lambda: bool(clouds), 20.0)
            assert clouds[0] > 500
            assert listener.value(_MAPPING, "session") == listener.value(_BACK_END, "session") > 0


@contextmanager
def slowed(pids: list[int], share: float, period_s: float = 0.1) -> Iterator[None]:
    """Give processes only a share of the time: stopped and continued in turn."""
    over = threading.Event()

    def alternate() -> None:
        while not over.is_set():
            for sign, seconds in ((signal.SIGSTOP, (1.0 - share) * period_s), (signal.SIGCONT, share * period_s)):
                for pid in pids:
                    os.kill(pid, sign)
                time.sleep(seconds)

    thread = threading.Thread(target=alternate)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        for pid in pids:
            os.kill(pid, signal.SIGCONT)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["demux_node", "frontend_node"])
def test_a_node_that_is_too_slow_leaves_out_the_oldest_says_so_and_its_queues_stay_short(
    demo: Path, parameter_file: Path, listener: GraphListener, name: str
) -> None:
    with NodeProcesses(demo_graph(demo, _LOOP, rate=1.0, audience=LISTENER), parameter_file) as processes:
        wait(listener, lambda: text(listener, _BACK_END, "tracking") == "TRACKING", processes=processes)
        with slowed([processes.pids[name]], 0.04):
            wait(listener, lambda: "too slow: " in listener.statuses[name].hint, 60.0, processes)
            waiting = [value for key, value in listener.statuses[name].values.items() if key.startswith("waiting.")]
            assert max(map(int, waiting)) < 300
        posed = listener.sessions.poses
        assert posed > 0
        wait(listener, lambda: text(listener, _BACK_END, "tracking") == "TRACKING", 60.0, processes)


def bounded_stop(process: subprocess.Popen[bytes], sign: int) -> tuple[int, str]:
    """Send a signal; return exit code and standard error. A process that does not stop fails the test."""
    process.send_signal(sign)
    _, errors = process.communicate(timeout=30)
    return process.returncode, errors.decode()


def command(node: NodeDescription) -> list[str]:
    parameters = [item for name, value in node.parameters.items() for item in ("-p", f"{name}:={value!r}")]
    return [sys.executable, "-m", node.module, "--ros-args", *parameters]


@pytest.mark.slow
@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("name", NODES)
def test_a_node_told_to_stop_at_any_moment_ends_with_code_0_and_no_traceback(demo: Path, name: str, sign: signal.Signals) -> None:
    (node,) = [node for node in demo_graph(demo, {"driver_node": {"wait_for": ""}}) if node.executable == name]
    seed = np.random.default_rng(NODES.index(name) * 100 + sign)
    for delay_s in seed.uniform(0.0, 4.0, 5):
        process = subprocess.Popen(command(node), stderr=subprocess.PIPE)
        time.sleep(delay_s)
        code, errors = bounded_stop(process, sign)
        # Before Python has taken the signals over, they end the process as they end any.
        assert code in (0, -sign), (delay_s, errors)
        assert "Traceback" not in errors, (delay_s, errors)
        assert code == 0 or delay_s < 3.0


@pytest.mark.parametrize("sign", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_replay_told_to_stop_writes_what_it_has(demo: Path, tmp_path: Path, sign: signal.Signals) -> None:
    out = tmp_path / "out"
    process = replay(demo, out)
    with GraphListener(load_calibration(demo / "calibration.yaml")) as listener:
        wait(listener, lambda: listener.value(_MAPPING, "points") > 500)
    code, errors = bounded_stop(process, sign)
    assert code == 0, errors
    assert "Traceback" not in errors
    assert re.search(r"interrupted after \d+\.\d s of the bag", errors), errors
    assert len((out / "trajectory.tum").read_text().splitlines()) > 10
    assert (out / "map.ply").stat().st_size > 5_000
