"""``vli live``: the node graph for a scanner that runs; what it publishes is written at the end."""

from __future__ import annotations

import argparse
import sys
import time

from tqdm import tqdm

from vli_bringup.arguments import (
    add_autosave_argument,
    add_parameter_arguments,
    add_result_arguments,
    add_topic_argument,
    duration,
    source_settings,
)
from vli_bringup.graph import STAGES
from vli_bringup.graph_run import MAPPING, GraphOptions, RunningGraph, report, run_graph
from vli_bringup.listener import GraphListener
from vli_bringup.output import ScanDirectory
from vli_common.calibration import load_calibration
from vli_common.status import NodeState
from vli_common.types import Mode

_BACK_END = "backend_node"
_PATIENCE_S = 5.0
"""Inputs that nobody publishes are told after this long."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``vli live``."""
    add_result_arguments(parser)
    add_parameter_arguments(parser)
    parser.add_argument("--duration", metavar="D", type=duration, help="stop after D seconds (default: at Ctrl-C)")
    add_autosave_argument(parser)
    add_topic_argument(parser)


def run(args: argparse.Namespace) -> int:
    """Scan until SIGINT, SIGTERM or the end of ``--duration`` and write the results.

    Returns:
        0; 1 where tracking never started; 2 where a node failed for good, and what had been scanned by then is written.

    Raises:
        VliError: nothing usable: calibration, parameters, output directory, or a node that failed.
    """
    mode = Mode(args.mode)
    settings = source_settings(args)
    calibration = load_calibration(args.calib, mode, args.imu_calib)
    options = GraphOptions(args.calib, args.imu_calib, calibration, settings, mode, autosave_s=args.autosave)
    results = ScanDirectory(args.out, args.overwrite)
    with results as directory:
        summary = run_graph(options, directory, args.started_s, lambda graph: _scan(graph, args.duration))
    return report(summary, results.path, "live")


def _scan(graph: RunningGraph, duration_s: float | None) -> None:
    """Wait until all nodes are ready, then until told to stop."""
    graph.wait_until(lambda: all(graph.listener.state(name) is NodeState.READY for _, name in STAGES), "the graph")
    begin_s = graph.begin()
    sys.stderr.write("vli live: ready; Ctrl-C ends the scan and writes the results\n")
    is_silence_told = False
    with tqdm(bar_format="{desc}", disable=not sys.stderr.isatty(), leave=False) as line:
        while not graph.stop.is_set() and (duration_s is None or graph.data_s < duration_s):
            graph.spin()
            graph.data_s = time.perf_counter() - begin_s
            if graph.data_s > _PATIENCE_S and not is_silence_told:
                is_silence_told = True
                for text in _silent_inputs(graph.listener):
                    line.write(f"vli live: {text}", file=sys.stderr)
            line.set_description_str(_progress(graph.listener, graph.data_s))
    graph.stop.set()


def _silent_inputs(listener: GraphListener) -> list[str]:
    """Return a line for each input that nobody publishes, by what the stages say of themselves."""
    statuses = [listener.statuses[name] for _, name in STAGES if name in listener.statuses]
    unmatched = {item for status in statuses for item in status.values.get("unmatched", "").split(",") if item}
    return [f"nobody publishes '{name}' yet; start the driver, or name its topics with --topic" for name in sorted(unmatched)]


def _progress(listener: GraphListener, elapsed_s: float) -> str:
    status = listener.statuses.get(_BACK_END)
    said = f"{status.values.get('tracking', '')}: {status.values.get('reason', '')}" if status else ""
    return f"{elapsed_s:.0f} s, {listener.value(MAPPING, 'points')} map points, {said}"
