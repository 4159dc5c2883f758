"""``vli replay``: a bag through the node graph, at the bag's pace."""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from vli_bringup.arguments import add_scan_arguments, bag_topics, number, source_settings
from vli_bringup.graph import SCANNER, STAGES, Playback, describe_graph
from vli_bringup.input_checks import check_input, check_part
from vli_bringup.listener import LISTENER, GraphListener
from vli_bringup.output import CONFIG, SUMMARY, ResultsDirectory
from vli_bringup.processes import GraphError, NodeProcesses
from vli_bringup.recorder import Recorder
from vli_bringup.settings import Settings, to_yaml
from vli_bringup.stopping import stop_on_signals
from vli_common.calibration import Calibration, load_calibration
from vli_common.ply import read_cloud
from vli_common.status import NodeState
from vli_common.types import NANOSECONDS, Mode
from vli_driver.bag import BagReader
from vli_mapping.render import write_views

NEVER_TRACKED = 1
_READY_S = 300.0
_SAVE_S = 60.0
_PAUSE_S = 1.0
_SILENT_S = 60.0
"""A graph whose map has not grown and whose bag has not moved for this long hangs."""
_MAP = "map.ply"
_BACK_END, _DEMUX, _MAPPING = "backend_node", "demux_node", "mapping_node"


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """What to replay.

    Args:
        playback: the bag.
        calibration_path, imu_calibration_path: as the driver gets them.
        calibration: the same, validated.
        settings: of all stages.
        mode: which sensors take part.
    """

    playback: Playback
    calibration_path: Path
    imu_calibration_path: Path | None
    calibration: Calibration
    settings: Settings
    mode: Mode


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``vli replay``."""
    add_scan_arguments(parser)
    parser.add_argument("--rate", metavar="R", type=_rate, default=1.0, help="bag seconds a second (default: %(default)s)")


def run(args: argparse.Namespace) -> int:
    """Replay a bag and write the results; return 0, or 1 where tracking never started.

    Raises:
        VliError: nothing usable: bag, calibration, parameters, output directory, or a node that failed.
    """
    mode = Mode(args.mode)
    settings = source_settings(args)
    calibration = load_calibration(args.calib, mode, args.imu_calib)
    topics = bag_topics(settings, mode)
    warnings = check_input(BagReader(args.bag, topics), calibration, mode.uses_imu)
    check_part(BagReader(args.bag, topics, args.start, args.duration))
    playback = Playback(args.bag, args.rate, args.start, args.duration)
    options = ReplayOptions(playback, args.calib, args.imu_calib, calibration, settings, mode)
    results = ResultsDirectory(args.out, args.overwrite)
    with results as directory:
        summary = replay(options, directory, args.started_s)
    for warning in warnings:
        _note(f"warning: {warning}")
    return report(summary, results.path)


def replay(options: ReplayOptions, directory: Path, started_s: float) -> dict[str, Any]:
    """Play a bag through the graph and write what it publishes; return what ``summary.json`` got.

    Args:
        options: what to replay.
        directory: for the results, empty.
        started_s: ``time.perf_counter()`` when the command started.

    SIGINT and SIGTERM end the playback, not the command: what there is by then is written.

    Raises:
        GraphError: a node failed.
        KeyboardInterrupt: told to stop before the first frame.
    """
    recorder = Recorder(options.calibration)
    parameter_file = directory / CONFIG
    parameter_file.write_text(to_yaml(options.settings))
    nodes = describe_graph(
        options.calibration_path, options.mode, options.imu_calibration_path, options.playback, directory / _MAP, LISTENER
    )
    with stop_on_signals() as stop, NodeProcesses(nodes, parameter_file) as processes, GraphListener(recorder) as listener:
        _wait_until_ready(processes, listener, stop)
        begin_s = time.perf_counter()
        bag_s = _play(processes, listener, stop)
        wall_s = time.perf_counter() - begin_s
        if stop.is_set():
            _hand_over(listener)
        if listener.value(_MAPPING, "points"):
            listener.call(f"{_MAPPING}/save", _SAVE_S)
    recorder.write(directory)
    if (directory / _MAP).exists():
        write_views(directory / "cloud.png", read_cloud(directory / _MAP))
    summary = {
        "frames_long": listener.value(_DEMUX, "stage.long"),
        "frames_short": listener.value(_DEMUX, "stage.short"),
        "frames_with_pose": len(recorder.live),
        "keyframes": recorder.keyframes,
        "points": listener.value(_MAPPING, "points"),
        "states": recorder.states,
        "reason": recorder.reason,
        "startup_s": round(begin_s - started_s, 3),
        "wall_s": round(wall_s, 3),
        "cpu_s": round(sum(float(status.values["cpu_s"]) for status in listener.statuses.values()), 3),
        "realtime_factor": round(bag_s / wall_s, 3),
        "drops": listener.losses(),
        "restarts": processes.restarts,
        "interrupted_s": round(bag_s, 3) if stop.is_set() else None,
        "nodes": {name: dict(sorted(status.values.items())) for name, status in sorted(listener.statuses.items())},
    }
    (directory / SUMMARY).write_text(json.dumps(summary, indent=1) + "\n")
    return summary


def report(summary: dict[str, Any], path: Path) -> int:
    """Say what came out; return the exit code: of a replay that was told to stop, 0 whatever came out."""
    if summary["interrupted_s"] is not None:
        _note(f"interrupted after {summary['interrupted_s']:.1f} s of the bag")
    elif not summary["frames_with_pose"]:
        _note(f"tracking never started in {summary['frames_long']} long frames: {summary['reason']}")
        return NEVER_TRACKED
    if summary["drops"]:
        _note("warning: dropped " + ", ".join(f"{count} × {name}" for name, count in summary["drops"].items()))
    print(
        f"{summary['frames_with_pose']} poses of {summary['frames_long']} long frames, {summary['points']} map points; "
        f"results in '{path}'"
    )
    return 0


def _wait_until_ready(processes: NodeProcesses, listener: GraphListener, stop: threading.Event) -> None:
    """Return when the driver has begun: every node is ready and knows its neighbours."""
    deadline_s = time.monotonic() + _READY_S
    while not listener.value(SCANNER, "position_ns") and listener.state(SCANNER) is not NodeState.FINISHED:
        processes.check()
        if stop.is_set():
            raise KeyboardInterrupt
        if time.monotonic() > deadline_s:
            waiting = [name for _, name in STAGES if listener.state(name) is not NodeState.READY]
            raise GraphError(f"{', '.join(waiting) or SCANNER} not ready in {_READY_S:g} s")
        listener.spin()


def _play(processes: NodeProcesses, listener: GraphListener, stop: threading.Event) -> float:
    """Return the bag seconds played, when the last node has finished or all shall stop; a bar shows them on a terminal."""
    first_ns = last_ns = listener.value(SCANNER, "position_ns")
    moved_s = time.monotonic()
    with tqdm(unit="s", disable=not sys.stderr.isatty(), leave=False) as bar:
        while listener.state(_MAPPING) is not NodeState.FINISHED and not stop.is_set():
            processes.check()
            listener.spin()
            position_ns = listener.value(SCANNER, "position_ns")
            if position_ns != last_ns:
                last_ns, moved_s = position_ns, time.monotonic()
            elif time.monotonic() - moved_s > _SILENT_S:
                states = ", ".join(f"{name} {status.state.value}" for name, status in sorted(listener.statuses.items()))
                raise GraphError(f"the graph has not moved for {_SILENT_S:g} s: {states}")
            bar.update(max(0.0, round((last_ns - first_ns) / NANOSECONDS, 1) - bar.n))
    return (last_ns - first_ns) / NANOSECONDS


def _hand_over(listener: GraphListener) -> None:
    """Let the back end hand over its window before the map is saved, as at the end of the bag."""
    listener.call(f"{_BACK_END}/pause", _PAUSE_S)
    deadline_s = time.monotonic() + _PAUSE_S
    while listener.state(_BACK_END) is not NodeState.PAUSED and time.monotonic() < deadline_s:
        listener.spin()


def _rate(text: str) -> float:
    value = number(text)
    if not 0.01 <= value <= 100.0:
        raise argparse.ArgumentTypeError(f"'{text}', expected 0.01 to 100 bag seconds a second")
    return value


def _note(text: str) -> None:
    print(f"vli replay: {text}", file=sys.stderr)
