"""A run of the node graph: start it, hear what it publishes, and write that. What ``vli replay`` and ``vli live`` share."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vli_bringup.export import read_map
from vli_bringup.graph import AUTOSAVE, AUTOSAVE_S, STAGES, Playback, describe_graph
from vli_bringup.latency import FrameLatencies
from vli_bringup.listener import LISTENER, GraphListener
from vli_bringup.output import CONFIG, SUMMARY
from vli_bringup.path_saves import PathSaves
from vli_bringup.processes import GraphError, NodeProcesses
from vli_bringup.settings import Settings, to_yaml
from vli_bringup.stopping import stop_on_signals
from vli_bringup.watch import GraphWatch
from vli_common.calibration import Calibration
from vli_common.status import NodeState
from vli_common.types import Mode
from vli_mapping.map_file import SUFFIX, session_of
from vli_mapping.render import write_views
from vli_mapping.store import write_ply

NEVER_TRACKED = 1
_FAILED = 2
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
        autosave_s: seconds between automatic saves of the map, with which a mapping node that has crashed goes on, and of the
            path; 0: never.
    """

    calibration_path: Path
    imu_calibration_path: Path | None
    calibration: Calibration
    settings: Settings
    mode: Mode
    playback: Playback | None = None
    autosave_s: float = AUTOSAVE_S


class RunningGraph:
    """The graph while it runs.

    Args:
        processes: of the nodes.
        listener: that hears them.
        stop: set once the run shall end.
        saves: keep the path meanwhile.
    """

    def __init__(self, processes: NodeProcesses, listener: GraphListener, stop: threading.Event, saves: PathSaves) -> None:
        self.listener, self.stop = listener, stop
        self.begin_s: float | None = None
        """When data began (``time.perf_counter()``)."""
        self.data_s = 0.0
        """Seconds of data so far."""
        self._processes, self._watch, self._saves = processes, GraphWatch(processes), saves

    def begin(self) -> float:
        """Note that data begin now; return when that is."""
        self.begin_s = time.perf_counter()
        return self.begin_s

    def spin(self) -> None:
        """Handle what comes within a tenth of a second, and look after the nodes.

        Raises:
            GraphError: a node has ended for good.
        """
        self._processes.check()
        self.listener.spin()
        self._watch.look(self.listener.statuses, self.listener.heard_s)
        self._saves.look()

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

    def follow(self, follow: Callable[[RunningGraph], None]) -> str:
        """Let ``follow`` wait for the end; return why there is none, where the graph failed after something had been scanned.

        Raises:
            GraphError: it failed before that.
        """
        try:
            follow(self)
        except GraphError as error:
            if not self.listener.sessions.poses:
                raise
            return str(error)
        return ""

    def hand_over(self, is_cut_short: bool) -> list[str]:
        """Have the map saved, of a graph that is cut short with the window, as at the end of the bag; return what went wrong."""
        problems = []
        if is_cut_short and self._processes.is_running(_BACK_END):
            problems.append(self._call(_BACK_END, "pause", _PAUSE_S))
            deadline_s = time.monotonic() + _PAUSE_S
            while not problems[0] and self.listener.state(_BACK_END) is not NodeState.PAUSED and time.monotonic() < deadline_s:
                self.listener.spin()
        if self._processes.is_running(MAPPING) and self.listener.value(MAPPING, "points"):
            problems.append(self._call(MAPPING, "save", _SAVE_S))
        return [text for text in problems if text]

    def _call(self, node: str, service: str, timeout_s: float) -> str:
        """Call a service and return what went wrong: that must not cost what has been recorded so far."""
        try:
            self.listener.call(f"{node}/{service}", timeout_s, lambda: self._processes.is_running(node))
        except GraphError as error:
            return str(error)
        return ""


def run_graph(options: GraphOptions, directory: Path, started_s: float, follow: Callable[[RunningGraph], None]) -> dict[str, Any]:
    """Run the graph and write what it publishes; return what ``summary.json`` got.

    SIGINT and SIGTERM end the run, not the command: what there is by then is written.

    Args:
        options: what to run.
        directory: for the results, empty.
        started_s: ``time.perf_counter()`` when the command started.
        follow: waits for the first frame, says that data begin, and waits for the end.

    Raises:
        GraphError: a node failed before anything was scanned; of one that fails later, the summary says so.
        KeyboardInterrupt: told to stop before the first frame.
    """
    latencies = FrameLatencies(options.playback.rate if options.playback else 1.0)
    (directory / CONFIG).write_text(to_yaml(options.settings))
    nodes = describe_graph(
        options.calibration_path,
        options.mode,
        options.imu_calibration_path,
        options.playback,
        directory / _MAP,
        options.autosave_s,
        LISTENER,
        options.settings.driver,
    )
    with (
        stop_on_signals() as stop,
        NodeProcesses(nodes, directory / CONFIG) as processes,
        GraphListener(options.calibration, latencies) as listener,
    ):
        sessions = listener.sessions
        saves = PathSaves(sessions, directory, options.autosave_s)
        graph = RunningGraph(processes, listener, stop, saves)
        failure = graph.follow(follow)
        now_s = time.perf_counter()
        begin_s = graph.begin_s or now_s
        wall_s = now_s - begin_s
        problems = graph.hand_over(is_cut_short=stop.is_set() or bool(failure))
        # All is on the disk before the graph is left: what the middleware does then is not ours.
        earlier = sessions.write(directory)
        saves.remove()
        latencies.write(directory / "timing.csv")
        _fall_back(directory, sessions.number)
        summary = {
            "frames_long": listener.value(_DEMUX, "stage.long"),
            "frames_short": listener.value(_DEMUX, "stage.short"),
            "frames_with_pose": sessions.poses,
            "keyframes": sessions.keyframes,
            "points": _write_map(directory, options.settings),
            "states": sessions.recorder.states,
            "reason": sessions.recorder.reason,
            "failure": failure,
            "sessions": [path.name for path in earlier.values()],
            "startup_s": round(begin_s - started_s, 3),
            "wall_s": round(wall_s, 3),
            "cpu_s": round(sum(float(status.values["cpu_s"]) for status in listener.statuses.values()), 3),
            "realtime_factor": round(graph.data_s / wall_s, 3) if options.playback and wall_s else None,
            **latencies.summary(),
            "drops": listener.losses(),
            "problems": problems,
            "restarts": processes.restarts,
            "interrupted_s": round(graph.data_s, 3) if stop.is_set() and options.playback else None,
            "nodes": {name: dict(sorted(status.values.items())) for name, status in sorted(listener.statuses.items())},
        }
        (directory / SUMMARY).write_text(json.dumps(summary, indent=1) + "\n")
    _put_away_saves(directory, sessions.number, earlier, options.settings)
    return summary


def report(summary: dict[str, Any], path: Path, command: str) -> int:
    """Say what came out; return the exit code: of a replay that was told to stop, 0 whatever came out; of a failure, 2."""

    def note(text: str) -> None:
        sys.stderr.write(f"vli {command}: {text}\n")

    if summary["failure"]:
        note(f"{summary['failure']}; what had been scanned by then is written")
    elif summary["interrupted_s"] is not None:
        note(f"interrupted after {summary['interrupted_s']:.1f} s of the bag")
    elif not summary["frames_with_pose"]:
        note(f"tracking never started in {summary['frames_long']} long frames: {summary['reason']}")
        return NEVER_TRACKED
    for problem in summary["problems"]:
        note(f"warning: {problem}")
    for name in summary["sessions"]:
        note(f"warning: a session ended in the middle, and what was scanned in it is in '{path / name}'; join with: vli merge")
    if summary["drops"]:
        note("warning: dropped " + ", ".join(f"{count} × {name}" for name, count in summary["drops"].items()))
    print(
        f"{summary['frames_with_pose']} poses of {summary['frames_long']} long frames, {summary['points']} map points; "
        f"results in '{path}'"
    )
    return _FAILED if summary["failure"] else 0


def _write_map(directory: Path, settings: Settings) -> int:
    """Write cloud and picture of the map in a directory; return its points."""
    path = directory / _MAP
    if not path.exists():
        return 0
    cloud = read_map(path, settings.mapping.colour)
    write_ply(directory / "map.ply", cloud)
    write_views(directory / "cloud.png", cloud)
    return len(cloud)


def _fall_back(directory: Path, session: int) -> None:
    """Where the map was not saved in the end, take the last automatic save of this session, if not of an earlier one."""
    path, save = directory / _MAP, directory / AUTOSAVE
    if not path.exists() and save.exists() and session_of(save) in (session, None):
        save.replace(path)


def _put_away_saves(directory: Path, session: int, earlier: Mapping[int, Path], settings: Settings) -> None:
    """Give earlier sessions the maps that mapping kept of them, else its last save; one of this session is in the map itself."""
    save = directory / AUTOSAVE
    for number, path in earlier.items():
        kept = save.with_stem(f"{save.stem}_session-{number}")
        if kept.exists() or session_of(save) == number:
            (kept if kept.exists() else save).replace(path / _MAP)
            _write_map(path, settings)
    if not (directory / _MAP).exists():
        _fall_back(directory, session)
        _write_map(directory, settings)
    elif session_of(save) == session:
        save.unlink()
