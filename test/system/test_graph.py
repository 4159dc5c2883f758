"""The node graph, in processes: each node starts and stops cleanly, nothing is lost between them, and a failure is told."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from graph_tools import NODES, START_S, command, wait
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from patience import is_running
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu
from tiny_bag import TinyBag, write_calibration

from vli_bringup.cli import main
from vli_bringup.graph import SCANNER, NodeDescription, Playback, describe_graph
from vli_bringup.listener import LISTENER, GraphListener
from vli_bringup.processes import MAX_RESTARTS, GraphError, NodeProcesses
from vli_common.calibration import load_calibration
from vli_common.geometry import align
from vli_common.messages import status_from_message
from vli_common.node.transport import message_type, quality
from vli_common.status import NodeState
from vli_common.topics import STATUS

pytestmark = pytest.mark.graph

_ANSWER_S = 60.0


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    return write_calibration(tmp_path / "calibration.yaml")


@pytest.fixture
def listener(calibration: Path) -> Iterator[GraphListener]:
    with GraphListener(load_calibration(calibration)) as item:
        yield item


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM])
def test_every_node_started_singly_stops_cleanly_on_a_signal(listener: GraphListener, sign: signal.Signals) -> None:
    # Nobody publishes a clock: a node answers and stops all the same.
    processes = {name: subprocess.Popen(command(name, "use_sim_time:=true"), stderr=subprocess.PIPE) for name in NODES}
    try:
        wait(listener, lambda: set(NODES) <= set(listener.statuses))
        wait(listener, lambda: listener.state("frontend_node") is NodeState.WAITING)
        assert "calibration_file" in listener.statuses["frontend_node"].hint
        for process in processes.values():
            process.send_signal(sign)
        results = {name: (process.communicate(timeout=20)[1], process.returncode) for name, process in processes.items()}
        assert results == dict.fromkeys(NODES, (b"", 0))
    finally:
        for process in processes.values():
            process.kill()


@pytest.mark.parametrize(
    ("executable", "parameter", "complaint"),
    [
        ("demux_node", "stripe.min_snr:=1.0", "'stripe.min_snr' is '1.0', expected 3.0 to 50.0"),
        ("frontend_node", "no_such_thing:=1", "unknown parameter 'no_such_thing', did you mean '"),
        ("backend_node", "mode:=vlsi", "'mode' is 'vlsi', expected one of vli-slam, vli-odom, vi, vl"),
        (
            "mapping_node",
            "calibration_file:=none.yaml",
            "calibration 'none.yaml': no such file; make one with 'vli calibrate camera",
        ),
        ("driver_node", "bag:=none", "bag 'none' does not exist"),
    ],
)
def test_a_node_that_cannot_start_says_why_in_one_line(executable: str, parameter: str, complaint: str) -> None:
    result = subprocess.run(command(executable, parameter), capture_output=True, text=True, timeout=START_S, check=False)
    assert complaint in result.stderr
    assert result.stderr.count("\n") == 1
    assert result.returncode == 2


def change_state(listener: GraphListener, node: str, transition: int) -> bool:
    """Do what a lifecycle manager does; return whether the node obeyed."""
    client = listener.node.create_client(ChangeState, f"{node}/change_state")
    assert client.wait_for_service(START_S)
    future = client.call_async(ChangeState.Request(transition=Transition(id=transition)))
    wait(listener, future.done, 30.0)
    listener.node.destroy_client(client)
    return bool(future.result().success)


def test_a_lifecycle_manager_takes_a_node_through_its_states(listener: GraphListener, calibration: Path) -> None:
    process = subprocess.Popen(command("demux_node", "autostart:=false", f"calibration_file:={calibration}"))
    try:
        for transition, state in (
            (None, NodeState.UNCONFIGURED),
            (Transition.TRANSITION_CONFIGURE, NodeState.INACTIVE),
            (Transition.TRANSITION_ACTIVATE, NodeState.READY),
            (Transition.TRANSITION_DEACTIVATE, NodeState.INACTIVE),
            (Transition.TRANSITION_CLEANUP, NodeState.UNCONFIGURED),
            (Transition.TRANSITION_CONFIGURE, NodeState.INACTIVE),
            (Transition.TRANSITION_ACTIVATE, NodeState.READY),
        ):
            assert transition is None or change_state(listener, "demux_node", transition)
            wait(listener, lambda state=state: listener.state("demux_node") is state)
        assert change_state(listener, "demux_node", Transition.TRANSITION_ACTIVE_SHUTDOWN)
        assert process.wait(10.0) == 0
    finally:
        process.kill()


def test_a_node_that_cannot_be_configured_stays_as_it_is(listener: GraphListener) -> None:
    process = subprocess.Popen(
        command("demux_node", "autostart:=false", "calibration_file:=none.yaml"), stderr=subprocess.DEVNULL
    )
    try:
        wait(listener, lambda: listener.state("demux_node") is NodeState.UNCONFIGURED)
        assert not change_state(listener, "demux_node", Transition.TRANSITION_CONFIGURE)
        wait(listener, lambda: listener.state("demux_node") is NodeState.UNCONFIGURED)
        assert process.poll() is None
    finally:
        process.kill()


def test_a_sensor_that_publishes_as_best_effort_is_heard(listener: GraphListener) -> None:
    process = subprocess.Popen(command("frontend_node"), stderr=subprocess.PIPE, text=True)
    publisher = listener.node.create_publisher(Imu, "/imu", qos_profile_sensor_data)
    try:

        def is_heard() -> bool:
            publisher.publish(Imu())
            return listener.value("frontend_node", "received./imu") > 0

        wait(listener, is_heard)
        process.send_signal(signal.SIGINT)
        told = process.communicate(timeout=20)[1]
        assert "'replay' offers best effort volatile, reliable volatile was asked for; heard as best effort" in told
    finally:
        process.kill()


def test_a_reset_begins_a_new_session_in_every_node(
    tmp_path: Path, calibration: Path, parameter_file: Path, listener: GraphListener
) -> None:
    with NodeProcesses(describe_graph(calibration), parameter_file) as processes:
        wait(listener, lambda: all(listener.state(name) is NodeState.READY for name in NODES))
        processes.check()
        for number, name in enumerate(["mapping_node", "demux_node"], start=1):
            assert listener.call(f"{name}/reset", _ANSWER_S) == f"session {number}"
            wait(listener, lambda number=number: all(listener.value(node, "session") == number for node in NODES))
        listener.call("frontend_node/pause", _ANSWER_S)
        wait(listener, lambda: listener.state("frontend_node") is NodeState.PAUSED)
        listener.call("frontend_node/resume", _ANSWER_S)
        wait(listener, lambda: listener.state("frontend_node") is NodeState.READY)
        with pytest.raises(GraphError, match="the map is empty"):
            listener.call("mapping_node/save", _ANSWER_S)
        pids = processes.pids
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids.values())


def test_a_bag_that_is_played_again_and_again_loses_nothing_between_its_end_and_its_beginning(
    tmp_path: Path, calibration: Path, parameter_file: Path, listener: GraphListener
) -> None:
    nodes = describe_graph(calibration, playback=Playback(TinyBag().write(tmp_path / "bag")), audience=LISTENER)
    looped = [
        replace(node, parameters={**node.parameters, "loop": True}) if node.executable == SCANNER else node for node in nodes
    ]
    finished: set[tuple[str, str]] = set()

    def note(message: object) -> None:
        status = status_from_message(message)
        if status.state is NodeState.FINISHED:
            finished.add((status.node, status.values["session"]))

    listener.node.create_subscription(message_type(STATUS), STATUS.name, note, quality(STATUS, reading=True))
    with NodeProcesses(looped, parameter_file) as processes:
        wanted = {(name, session) for name in NODES for session in "12"}
        wait(listener, lambda: finished >= wanted, processes=processes)
        wait(listener, lambda: listener.value("mapping_node", "session") >= 3, processes=processes)
    assert "node.dropped_by_session" not in {
        key for status in listener.statuses.values() for key, value in status.values.items() if value != "0"
    }


def killed(processes: NodeProcesses, name: str) -> None:
    """Kill a node; return once its end is known."""
    os.kill(processes.pids[name], signal.SIGKILL)
    while processes.is_running(name):
        time.sleep(0.01)


def test_what_plays_a_bag_is_not_started_again_and_no_node_is_left_behind(
    tmp_path: Path, calibration: Path, parameter_file: Path
) -> None:
    # Nobody of that name ever listens: the driver waits with the bag until it is killed.
    nodes = describe_graph(calibration, playback=Playback(TinyBag().write(tmp_path / "bag")), audience=LISTENER)
    with NodeProcesses(nodes, parameter_file) as processes:
        pids = processes.pids
        killed(processes, "driver_node")
        with pytest.raises(GraphError, match="driver_node was ended by SIGKILL"):
            processes.check()
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids.values())


def test_a_node_that_crashes_again_and_again_ends_the_graph(calibration: Path, parameter_file: Path) -> None:
    told: list[str] = []
    with NodeProcesses(describe_graph(calibration)[1:2], parameter_file, told.append) as processes:
        for _ in range(MAX_RESTARTS):
            killed(processes, "demux_node")
            processes.check()
        assert told == ["demux_node was ended by SIGKILL; it is started again"] * MAX_RESTARTS
        assert processes.restarts == {"demux_node": MAX_RESTARTS}
        killed(processes, "demux_node")
        with pytest.raises(GraphError, match="demux_node crashed more than 3 times in 60 s: demux_node was ended by SIGKILL"):
            processes.check()


def test_the_nodes_stop_when_the_command_that_started_them_is_killed(calibration: Path, parameter_file: Path) -> None:
    script = f"""
import pathlib, time
from vli_bringup.graph import describe_graph
from vli_bringup.processes import NodeProcesses
with NodeProcesses(describe_graph(pathlib.Path({str(calibration)!r})), pathlib.Path({str(parameter_file)!r})) as processes:
    print(*processes.pids.values(), flush=True)
    time.sleep(600)
"""
    command = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert command.stdout is not None
    pids = command.stdout.readline().split()
    command.kill()
    command.wait(10)
    deadline_s = time.monotonic() + START_S
    while any(is_running(pid) for pid in pids):
        assert time.monotonic() < deadline_s
        time.sleep(0.1)


def test_the_last_line_of_a_node_that_cannot_start_is_the_error_of_the_graph(tmp_path: Path, parameter_file: Path) -> None:
    playback = Playback(tmp_path / "none")
    driver: list[NodeDescription] = describe_graph(write_calibration(tmp_path / "c.yaml"), playback=playback)[:1]
    with NodeProcesses(driver, parameter_file) as processes:
        deadline_s = time.monotonic() + START_S
        with pytest.raises(GraphError, match="does not exist; expected a rosbag2 directory"):  # noqa: PT012
            while time.monotonic() < deadline_s:
                processes.check()
                time.sleep(0.1)


def test_the_doctor_listens_to_a_running_sensor(tmp_path: Path, calibration: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--live", "--duration", "1"]) == 1
    assert "nobody publishes '/imu'" in capsys.readouterr().out
    bag = TinyBag(seconds=40.0).write(tmp_path / "bag")
    driver = subprocess.Popen(command("driver_node", f"bag:={bag}", "loop:=true"))
    try:
        deadline_s = time.monotonic() + START_S
        out = ""
        while "IMU and camera overlap" not in out or "driver_node" not in out:
            assert time.monotonic() < deadline_s, out
            main(["doctor", "--live", "--duration", "2", "--calib", str(calibration)])
            out = capsys.readouterr().out
        assert "long and" in out
        assert "measures gravity in m/s²" in out
    finally:
        driver.terminate()
        driver.wait(20)


def test_replay_of_noise_passes_every_frame_and_says_that_tracking_never_started(
    tmp_path: Path, calibration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = TinyBag().write(tmp_path / "bag")
    out = tmp_path / "out"
    assert main(["replay", str(bag), "--calib", str(calibration), "--out", str(out), "--rate", "0.5"]) == 1
    summary = json.loads((out / "summary.json").read_text())
    assert summary["frames_long"] + summary["frames_short"] == 120
    assert summary["drops"] == {}
    assert "tracking never started in 60 long frames: " in capsys.readouterr().err
    assert (out / "trajectory.tum").read_text() == ""


def test_replay_of_a_recording_tracks_and_maps_what_the_scanner_saw(tmp_path: Path, shared_data: Path) -> None:
    """Half the pace, so that a busy machine drops nothing; the figures at full pace are a matter of test/perf."""
    recording, out = shared_data / "keyboard_short", tmp_path / "out"
    options = ["--calib", str(recording / "calibration.yaml"), "--out", str(out), "--duration", "8", "--rate", "0.5"]
    assert main(["replay", str(recording / "bag"), *options]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["drops"] == {}
    assert summary["frames_with_pose"] >= 0.9 * summary["frames_long"]
    assert summary["points"] > 10_000
    assert {path.name for path in out.iterdir()} == {
        "cloud.png", "config.yaml", "covariance.csv", "map.ply", "map.vli", "summary.json", "timing.csv", "trajectory.tum",
        "trajectory_final.tum",
    }  # fmt: skip
    for name in ("trajectory.tum", "trajectory_final.tum"):
        assert rmse(np.loadtxt(out / name), np.loadtxt(recording / "truth.tum")) < 3e-4


def rmse(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Return the translation RMSE in metres after alignment, at equal stamps."""
    nearest = np.abs(truth[:, :1] - estimate[:, 0]).argmin(axis=0)
    T, _ = align(estimate[:, 1:4], truth[nearest, 1:4])
    residual = estimate[:, 1:4] @ T[:3, :3].T + T[:3, 3] - truth[nearest, 1:4]
    return float(np.sqrt((residual**2).sum(axis=1).mean()))
