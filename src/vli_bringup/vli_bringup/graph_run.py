"""A run of the node graph: start it, hear what it publishes, and write that. What ``vli replay`` and ``vli live`` share."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vli_bringup.export import read_map
from vli_bringup.graph import STAGES, Playback, describe_graph
from vli_bringup.latency import FrameLatencies
from vli_bringup.listener import LISTENER, GraphListener
from vli_bringup.output import CONFIG, SUMMARY
from vli_bringup.processes import GraphError, NodeProcesses
from vli_bringup.recorder import Recorder
from vli_bringup.settings import Settings, to_yaml
from vli_bringup.stopping import stop_on_signals
from vli_bringup.watch import GraphWatch
from vli_common.calibration import Calibration
from vli_common.status import NodeState
from vli_common.types import Mode
from vli_mapping.map_file import SUFFIX
from vli_mapping.render import write_views
from vli_mapping.store import write_ply

NEVER_TRACKED = 1
MAPPING = "mapping_node"
_BACK_END, _DEMUX = "backend_node", "demux_node"
_READY_S = 300.0
_SAVE_S = 60.0
_PAUSE_S = 5.0
_MAP = f"map{SUFFIX}"


@dataclass(frozen=True, slots=True)
class GraphOptions:
    """What to run.

    Args:
        calibration_path, imu_calibration_path: as the driver gets them.
        calibration: the same, validated.
        settings: of all stages.
        mode: which sensors take part.
        playback: the bag; None for a sensor that is there.
    """

    calibration_path: Path
    imu_calibration_path: Path | None
    calibration: Calibration
    settings: Settings
    mode: Mode
    playback: Playback | None = None


class RunningGraph:
    """The graph while it runs.

    Args:
        processes: of the nodes.
        listener: that hears them.
        stop: set once the run shall end.
    """

    def __init__(self, processes: NodeProcesses, listener: GraphListener, stop: threading.Event) -> None:
        self.listener, self.stop = listener, stop
        self._processes, self._watch = processes, GraphWatch(processes)

    def spin(self) -> None:
        """Handle what comes within a tenth of a second, and look after the nodes.

        Raises:
            GraphError: a node has ended for good.
        """
        self._processes.check()
        self.listener.spin()
        self._watch.look(self.listener.statuses, self.listener.heard_s)

    def wait_until(self, is_ready: Callable[[], bool], blamed: str) -> None:
        """Return when ``is_ready`` says so.

        Raises:
            GraphError: it did not within five minutes; the stages that are not ready are named, else ``blamed``.
            KeyboardInterrupt: told to stop before.
        """
        deadline_s = time.monotonic() + _READY_S
        while not is_ready():
            self.spin()
            if self.stop.is_set():
                raise KeyboardInterrupt
            if time.monotonic() > deadline_s:
                waiting = [name for _, name in STAGES if self.listener.state(name) is not NodeState.READY]
                raise GraphError(f"{', '.join(waiting) or blamed} not ready in {_READY_S:g} s")


def run_graph(
    options: GraphOptions, directory: Path, started_s: float, follow: Callable[[RunningGraph], tuple[float, float]]
) -> dict[str, Any]:
    """Run the graph and write what it publishes; return what ``summary.json`` got.

    SIGINT and SIGTERM end the run, not the command: what there is by then is written.

    Args:
        options: what to run.
        directory: for the results, empty.
        started_s: ``time.perf_counter()`` when the command started.
        follow: waits for the first frame and then for the end; returns when (``time.perf_counter()``) data began, and the
            seconds of data.

    Raises:
        GraphError: a node failed.
        KeyboardInterrupt: told to stop before the first frame.
    """
    recorder = Recorder(options.calibration)
    latencies = FrameLatencies(options.playback.rate if options.playback else 1.0)
    (directory / CONFIG).write_text(to_yaml(options.settings))
    nodes = describe_graph(
        options.calibration_path,
        options.mode,
        options.imu_calibration_path,
        options.playback,
        directory / _MAP,
        LISTENER,
        options.settings.driver,
    )
    with (
        stop_on_signals() as stop,
        NodeProcesses(nodes, directory / CONFIG) as processes,
        GraphListener(recorder, latencies) as listener,
    ):
        begin_s, data_s = follow(RunningGraph(processes, listener, stop))
        wall_s = time.perf_counter() - begin_s
        problems = [_hand_over(listener)] if stop.is_set() else []
        problems += [_call(listener, f"{MAPPING}/save", _SAVE_S)] if listener.value(MAPPING, "points") else []
        # All is on the disk before the graph is left: what the middleware does then is not ours.
        recorder.write(directory)
        latencies.write(directory / "timing.csv")
        summary = {
            "frames_long": listener.value(_DEMUX, "stage.long"),
            "frames_short": listener.value(_DEMUX, "stage.short"),
            "frames_with_pose": len(recorder.live),
            "keyframes": recorder.keyframes,
            "points": _write_map(directory, options.settings),
            "states": recorder.states,
            "reason": recorder.reason,
            "startup_s": round(begin_s - started_s, 3),
            "wall_s": round(wall_s, 3),
            "cpu_s": round(sum(float(status.values["cpu_s"]) for status in listener.statuses.values()), 3),
            "realtime_factor": round(data_s / wall_s, 3) if options.playback else None,
            **latencies.summary(),
            "drops": listener.losses(),
            "problems": [text for text in problems if text],
            "restarts": processes.restarts,
            "interrupted_s": round(data_s, 3) if stop.is_set() and options.playback else None,
            "nodes": {name: dict(sorted(status.values.items())) for name, status in sorted(listener.statuses.items())},
        }
        (directory / SUMMARY).write_text(json.dumps(summary, indent=1) + "\n")
    return summary


def report(summary: dict[str, Any], path: Path, command: str) -> int:
    """Say what came out; return the exit code: of a replay that was told to stop, 0 whatever came out."""

    def note(text: str) -> None:
        sys.stderr.write(f"vli {command}: {text}\n")

    if summary["interrupted_s"] is not None:
        note(f"interrupted after {summary['interrupted_s']:.1f} s of the bag")
    elif not summary["frames_with_pose"]:
        note(f"tracking never started in {summary['frames_long']} long frames: {summary['reason']}")
        return NEVER_TRACKED
    for problem in summary["problems"]:
        note(f"warning: {problem}")
    if summary["drops"]:
        note("warning: dropped " + ", ".join(f"{count} × {name}" for name, count in summary["drops"].items()))
    print(
        f"{summary['frames_with_pose']} poses of {summary['frames_long']} long frames, {summary['points']} map points; "
        f"results in '{path}'"
    )
    return 0


def _write_map(directory: Path, settings: Settings) -> int:
    """Write cloud and picture of the map that was saved; return its points."""
    if not (directory / _MAP).exists():
        return 0
    cloud = read_map(directory / _MAP, settings.mapping.colour)
    write_ply(directory / "map.ply", cloud)
    write_views(directory / "cloud.png", cloud)
    return len(cloud)


def _hand_over(listener: GraphListener) -> str:
    """Let the back end hand over its window before the map is saved, as at the end of the bag; return what went wrong."""
    problem = _call(listener, f"{_BACK_END}/pause", _PAUSE_S)
    deadline_s = time.monotonic() + _PAUSE_S
    while not problem and listener.state(_BACK_END) is not NodeState.PAUSED and time.monotonic() < deadline_s:
        listener.spin()
    return problem


def _call(listener: GraphListener, service: str, timeout_s: float) -> str:
    """Call a service and return what went wrong: that must not cost what has been recorded so far."""
    try:
        listener.call(service, timeout_s)
    except GraphError as error:
        return str(error)
    return ""
