"""``vli replay``: a bag through the node graph, at the bag's pace."""

from __future__ import annotations

import argparse
import sys
import time

from tqdm import tqdm

from vli_bringup.arguments import add_autosave_argument, add_scan_arguments, bag_topics, number, source_settings
from vli_bringup.graph import SCANNER, Playback
from vli_bringup.graph_run import MAPPING, GraphOptions, RunningGraph, report, run_graph
from vli_bringup.input_checks import check_input, check_part
from vli_bringup.output import ResultsDirectory
from vli_bringup.processes import GraphError
from vli_common.calibration import load_calibration
from vli_common.status import NodeState
from vli_common.types import NANOSECONDS, Mode
from vli_driver.bag import BagReader

_SILENT_S = 60.0
"""A graph whose map has not grown and whose bag has not moved for this long hangs."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``vli replay``."""
    add_scan_arguments(parser)
    add_autosave_argument(parser)
    parser.add_argument("--rate", metavar="R", type=_rate, default=1.0, help="bag seconds a second (default: %(default)s)")


def run(args: argparse.Namespace) -> int:
    """Replay a bag and write the results.

    Returns:
        0; 1 where tracking never started; 2 where a node failed for good, and what there was by then is written.

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
    options = GraphOptions(args.calib, args.imu_calib, calibration, settings, mode, playback, args.autosave)
    results = ResultsDirectory(args.out, args.overwrite)
    with results as directory:
        summary = run_graph(options, directory, args.started_s, _play)
    of_bag = summary["nodes"].get(SCANNER, {}).get("bag_warnings")
    for warning in [*warnings, *([of_bag] if of_bag else [])]:
        print(f"vli replay: warning: {warning}", file=sys.stderr)
    return report(summary, results.path, "replay")


def _play(graph: RunningGraph) -> None:
    """Wait until the driver has begun, which it does when every node is ready and knows its neighbours; then until the end.

    That is when the last node has finished, or all are told to stop. A bar shows the bag seconds on a terminal.
    """
    listener = graph.listener
    graph.wait_until(lambda: bool(listener.value(SCANNER, "position_ns")) or _has_finished(graph, SCANNER), SCANNER)
    graph.begin()
    moved_s = time.monotonic()
    first_ns = last_ns = listener.value(SCANNER, "position_ns")
    with tqdm(unit="s", disable=not sys.stderr.isatty(), leave=False) as bar:
        while not _has_finished(graph, MAPPING) and not graph.stop.is_set():
            graph.spin()
            position_ns = listener.value(SCANNER, "position_ns")
            if position_ns != last_ns or _is_paused(graph):
                last_ns, moved_s = position_ns, time.monotonic()
            elif time.monotonic() - moved_s > _SILENT_S:
                states = ", ".join(f"{name} {status.state.value}" for name, status in sorted(listener.statuses.items()))
                raise GraphError(f"the graph has not moved for {_SILENT_S:g} s: {states}")
            graph.data_s = (last_ns - first_ns) / NANOSECONDS
            bar.update(max(0.0, round(graph.data_s, 1) - bar.n))


def _is_paused(graph: RunningGraph) -> bool:
    """Return True while someone has a node wait: that it does not move is no fault."""
    return any(status.state in (NodeState.PAUSED, NodeState.INACTIVE) for status in graph.listener.statuses.values())


def _has_finished(graph: RunningGraph, node: str) -> bool:
    return graph.listener.state(node) is NodeState.FINISHED


def _rate(text: str) -> float:
    value = number(text)
    if not 0.01 <= value <= 100.0:
        raise argparse.ArgumentTypeError(f"'{text}', expected 0.01 to 100 bag seconds a second")
    return value
