"""The node graph's figures against their bars: a table, no verdict.

    python test/perf/bench_graph.py [--bag ../shared/data/keyboard_short] [--only latency rate overhead hang kill soak stop]
                                    [--soak MINUTES] [--starts N] [--duration S]

Times mean something on an idle machine only. ``--bag`` is a directory with ``bag``, ``calibration.yaml`` and, for the errors,
``truth.tum``.

latency   the bag at its own pace: what is lost, time from when a long frame was due to its pose, errors against `vli run`
rate      the highest pace without a loss
overhead  processor time of each node beyond that of its stage: transport, executor, copies; the driver's stage is reading the bag
hang      nodes stand still (SIGSTOP), one or all, at random moments for up to 1.8 s: errors against the truth, what is lost
kill      each node killed (SIGKILL) five times: time until it works again in the graph, the others alive
soak      the bag again and again: growth of memory, latency of the first half and of the second
stop      all nodes started and stopped, SIGINT and SIGTERM in turn, at random moments: exit codes, complaints, shared memory left
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from graph_bench import NODES, Graph, Meter, PlayedSessions, Recording, graph, live, resident_mb, rmse_mm, run_offline

from vli_bringup.cli import main as vli
from vli_bringup.graph import describe_graph
from vli_bringup.listener import GraphListener
from vli_bringup.losses import left_out
from vli_bringup.processes import GraphError
from vli_bringup.tum import read_tum
from vli_common.arrays import FloatArray
from vli_common.node.shared_memory import remove_dead_segments
from vli_common.status import NodeState
from vli_common.stop_signals import held_back

DATA = Path(__file__).resolve().parents[3] / "shared/data/keyboard_short"
RATES = (1.0, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0)
KILLS = 5
LINKED_S = 2.0
HANGS = 6
_HANG_EVERY_S = (0.05, 0.6)
_HANG_S = (0.05, 0.2, 0.5, 1.0, 1.8)
_ALL_HANG = 0.2
"""Share of the hangs that are of the whole machine."""
STOP_S = 2.0
_SHARED_MEMORY = Path("/dev/shm")
_SETTLED = 1.0 / 6.0
"""Of a soak: what caches and buffers take until then is no growth."""


@dataclass
class Table:
    """Rows of figure, bar and what was measured."""

    rows: list[tuple[str, str, str]] = field(default_factory=list)

    def add(self, figure: str, bar: str, measured: str) -> None:
        """Add a row, and show it at once: a soak takes long."""
        self.rows.append((figure, bar, measured))
        print(f"{figure:58} {bar:18} {measured}", flush=True)


@dataclass(frozen=True)
class Bench:
    """What to measure, and where the figures go.

    Args:
        recording: the bag.
        options: of the command line.
        directory: for files of no interest.
        table: of the figures.
    """

    recording: Recording
    options: argparse.Namespace
    directory: Path
    table: Table

    def graph(self, rate: float = 1.0, **own: object):  # type: ignore[no-untyped-def]
        """Return the graph over the recording, see :func:`graph_bench.graph`."""
        return graph(self.recording, self.directory, rate, self.options.duration, own)

    def replay(self, rate: float = 1.0) -> tuple[dict[str, Any], Path]:
        """Return the summary and the results of ``vli replay``: what a user gets, without anyone else who listens."""
        results = self.directory / "replay"
        command = ["replay", str(self.recording.bag), "--calib", str(self.recording.calibration_path), "--out", str(results)]
        command += ["--overwrite", "--rate", str(rate)]
        command += ["--duration", str(self.options.duration)] if self.options.duration else []
        with contextlib.redirect_stdout(io.StringIO()):
            vli(command)
        return json.loads((results / "summary.json").read_text()), results

    def latency(self) -> None:
        """Losses, latency, and errors against those of the offline run."""
        summary, results = self.replay()
        self.table.add("drops at rate 1", "0", _losses(summary["drops"]))
        both = f"{summary['latency_ms_p50']:.0f} / {summary['latency_ms_p99']:.0f} ms ({summary['frames_long']} frames)"
        self.table.add("long frame due → pose, p50 / p99", "≤ 40 / 120 ms", both)
        truth = self.recording.directory / "truth.tum"
        if truth.exists():
            online = rmse_mm(read_tum(results / "trajectory.tum"), read_tum(truth))
            offline = rmse_mm(run_offline(self.recording, self.options.duration).live(), read_tum(truth))
            bar = f"≤ {1.3 * offline + 0.02:.3f} mm"
            self.table.add("trajectory RMSE, graph (offline)", bar, f"{online:.3f} mm ({offline:.3f} mm)")

    def rate(self) -> None:
        """The highest pace without losses, and what is lost first beyond it."""
        best, beyond = 0.0, ""
        for rate in RATES:
            if losses := self.replay(rate)[0]["drops"]:
                beyond = f"; at {rate:g} lost: {_losses(losses)}"
                break
            best = rate
        self.table.add("highest rate without drops", "≥ 1.5", f"{best:g}{beyond}")

    def overhead(self) -> None:
        """Processor time beyond the stages', per long frame."""
        with self.graph() as run:
            run.wait_for_frames()
            begin, begin_s = {name: run.value(name, "cpu_s") for name in NODES}, time.monotonic()
            run.play()
            seconds = time.monotonic() - begin_s
            used = {name: run.value(name, "cpu_s") - begin[name] for name in NODES}
            frames = run.value("demux_node", "stage.long")
        stages = run_offline(self.recording, self.options.duration).cpu_s
        for name in NODES:
            each = 1e3 * np.array([used[name], stages[name], used[name] - stages[name]]) / frames
            self.table.add(f"transport of {name}", "", "{2:.1f} ms a long frame ({0:.1f} − {1:.1f} of the stage)".format(*each))
        beyond = sum(used.values()) - sum(stages.values())
        machine = 100 * beyond / (seconds * (os.cpu_count() or 1))
        measured = f"{machine:.0f} % of the machine, {100 * beyond / sum(used.values()):.0f} % of what the graph uses"
        self.table.add("transport in all", "≤ 25 % of CPU", measured)

    def hang(self) -> None:
        """Stop nodes at random and let them go on: what a busy machine, a disk or a debugger does."""
        truth = self.recording.directory / "truth.tum"
        for seed in range(HANGS):
            with self.graph() as run:
                run.wait_for_frames()
                hangs = threading.Thread(target=_hang, args=(list(run.processes.pids.values()), seed, run.listener), daemon=True)
                hangs.start()
                run.play()
                hangs.join()
                losses, found = run.listener.losses(), live(run.recorder)
                lost = sum(state == "LOST" for _, state, _ in run.recorder.states)
            error = f"{rmse_mm(found, read_tum(truth)):.3f} mm, " if truth.exists() else ""
            self.table.add(
                f"hangs, seed {seed}: RMSE", "", f"{error}{len(found.stamps_ns)} poses, {lost} × LOST, lost: {_losses(losses)}"
            )

    def kill(self) -> None:
        """Kill each node five times; the graph goes on."""
        times: dict[str, list[float]] = {name: [] for name in NODES}
        with self.graph(loop=True) as run:
            run.wait_for_frames()
            for name in NODES * KILLS:
                try:
                    times[name].append(_kill(run, name))
                except GraphError as error:
                    self.table.add(f"kill −9 {name}", "lives", str(error))
                    return
        for name, seconds in times.items():
            self.table.add(
                f"kill −9 {name}, linked again: median / max", "< 2 s", f"{np.median(seconds):.1f} / {max(seconds):.1f} s"
            )
        good = sum(second < LINKED_S for seconds in times.values() for second in seconds)
        self.table.add("others live, linked again in time", "25 of 25", f"{good} of {len(NODES) * KILLS}")

    def soak(self) -> None:
        """Play the bag again and again."""
        minutes = self.options.soak
        memory: list[tuple[float, dict[str, float]]] = []
        with self.graph(loop=True) as run:
            run.wait_for_frames()
            meter, sessions = Meter(run.listener), PlayedSessions(run.listener)
            pids, begin_s = run.processes.pids, time.monotonic()
            while (now_s := time.monotonic()) < begin_s + 60.0 * minutes:
                memory.append((now_s - begin_s, {name: resident_mb(pid) for name, pid in pids.items()}))
                run.wait(lambda until_s=now_s + 2.0: time.monotonic() > until_s)  # type: ignore[misc]
            half_s = begin_s + 30.0 * minutes
            first, second = meter.latencies_ms(until_s=half_s), meter.latencies_ms(half_s)
            losses = sessions.undelivered() + left_out(list(run.listener.statuses.values()))
            played, restarts = len(sessions.complete), run.processes.restarts
        for name in NODES:
            self._growth(name, memory, lambda sample, name=name: sample[name])
        self._growth("all nodes", memory, lambda sample: sum(sample.values()))
        self.table.add(f"{minutes:g} min: p99, first half → second", "flat", f"{_p99(first):.0f} → {_p99(second):.0f} ms")
        self.table.add(f"lost in {played} times the bag, crashes", "0", f"{_losses(losses)}, {sum(restarts.values())}")

    def stop(self) -> None:
        """Start and stop all nodes at random moments."""
        rng = random.Random(0)
        codes, complaints, slow, longest = [], 0, 0, 0.0
        remove_dead_segments()
        before = set(_SHARED_MEMORY.iterdir())
        for index in range(self.options.starts):
            sign = (signal.SIGINT, signal.SIGTERM)[index % 2]
            for code, text, seconds in _start_and_stop(self.recording, sign, rng.uniform(0.3, 6.0)):
                codes.append(code)
                complaints += bool(text)
                slow += seconds > STOP_S
                longest = max(longest, seconds)
        count = len(codes)
        self.table.add(f"{self.options.starts} starts, exit code 0", f"{count} of {count}", f"{codes.count(0)} of {count}")
        self.table.add("slower than 2 s (longest)", "0", f"{slow} ({longest:.2f} s)")
        self.table.add("with anything on standard error", "0", str(complaints))
        left = [path.name for path in set(_SHARED_MEMORY.iterdir()) - before if path.name.startswith("fastrtps")]
        self.table.add("left in /dev/shm", "0", str(len(left)))

    def _growth(self, what: str, memory: list[tuple[float, dict[str, float]]], of: Callable[[dict[str, float]], float]) -> None:
        """Fit a line to the memory after the caches have filled; a sawtooth of the bag's loops is no growth."""
        times, sizes = np.array([at for at, _ in memory]), np.array([of(sample) for _, sample in memory])
        settled = times >= _SETTLED * times[-1]
        slope, _ = np.polyfit(times[settled], sizes[settled], 1)
        growth = slope * (times[-1] - times[settled][0]) / sizes[settled].mean()
        self.table.add(f"memory of {what}: mean, growth", "< 3 %", f"{sizes[settled].mean():.0f} MB, {100 * growth:+.1f} %")


def _hang(pids: list[int], seed: int, listener: GraphListener) -> None:
    """Stop one process, or all, again and again until the bag has been played."""
    rng = random.Random(seed)
    while listener.state("driver_node") is not NodeState.FINISHED:
        time.sleep(rng.uniform(*_HANG_EVERY_S))
        chosen = pids if rng.random() < _ALL_HANG else [rng.choice(pids)]
        for sign, seconds in ((signal.SIGSTOP, rng.choice(_HANG_S)), (signal.SIGCONT, 0.0)):
            for pid in chosen:
                os.kill(pid, sign)
            time.sleep(seconds)


def _kill(run: Graph, name: str) -> float:
    """Return the seconds from the death of a node until it works in the graph again."""
    others = {other: pid for other, pid in run.processes.pids.items() if other != name}
    since_ns, begin_s = time.time_ns(), time.monotonic()
    os.kill(run.processes.pids[name], signal.SIGKILL)
    run.wait(lambda: run.is_linked(name, since_ns), 60.0)
    seconds = time.monotonic() - begin_s
    if {other: run.processes.pids[other] for other in others} != others:
        raise GraphError(f"another node died when {name} was killed")
    # Three crashes in a minute end a graph: this is a bench, not a crash.
    run.processes.forgive()
    return seconds


def _start_and_stop(recording: Recording, sign: signal.Signals, after_s: float) -> list[tuple[int, bytes, float]]:
    """Return exit code, standard error and seconds to the end of each node."""
    arguments = ["--ros-args", "-p", f"calibration_file:={recording.calibration_path}"]
    commands = [[sys.executable, "-m", node.module, *arguments] for node in describe_graph(recording.calibration_path)]
    # As `vli` does: a signal waits until a node has its handlers.
    with held_back():
        processes = [subprocess.Popen(command, stderr=subprocess.PIPE) for command in commands]
    time.sleep(after_s)
    begin_s = time.monotonic()
    for process in processes:
        process.send_signal(sign)
    results = []
    for process in processes:
        errors = process.communicate()[1]
        results.append((process.returncode, errors, time.monotonic() - begin_s))
    return results


def _losses(losses: dict[str, int]) -> str:
    return ", ".join(f"{count} × {name}" for name, count in losses.items()) or "0"


def _p99(latencies: FloatArray) -> float:
    return float(np.percentile(latencies, 99)) if len(latencies) else float("nan")


SECTIONS: dict[str, Callable[[Bench], None]] = {
    "latency": Bench.latency,
    "rate": Bench.rate,
    "overhead": Bench.overhead,
    "hang": Bench.hang,
    "kill": Bench.kill,
    "soak": Bench.soak,
    "stop": Bench.stop,
}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bag", type=Path, default=DATA, help="directory of the recording")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS), help="sections (default: all)")
    parser.add_argument("--soak", type=float, default=30.0, metavar="MINUTES", help="length of the soak (default: %(default)s)")
    parser.add_argument("--starts", type=int, default=100, help="starts and stops (default: %(default)s)")
    parser.add_argument("--duration", type=float, default=None, metavar="S", help="seconds of the bag (default: all)")
    options = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(random.randint(1, 101)))
    with tempfile.TemporaryDirectory() as directory:
        bench = Bench(Recording(options.bag), options, Path(directory), Table())
        for name in options.only:
            SECTIONS[name](bench)


if __name__ == "__main__":
    main()
