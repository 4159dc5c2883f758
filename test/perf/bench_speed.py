"""Time per long frame of ``vli run``, all stages, against the bars: a table, no verdict.

    python test/perf/bench_speed.py [--recording ../shared/data/keyboard_short] [--runs N] [--modes vli-slam vli-odom]

Times mean something on an idle machine only. Runs in turn, each in a process of its own, as users have it. ``stolen`` is the
share of the processors that other machines took meanwhile, and ``busy`` what anything else here did, both of /proc/stat.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vli_bringup.timing import STAGES

DATA = Path(__file__).resolve().parents[3] / "shared/data/keyboard_short"
BARS = {"vli-slam": "9 / 20", "vli-odom": "7 / 16"}
"""Mean and 95th percentile, ms."""
_USER, _NICE, _SYSTEM, _IDLE, _WAITING, _STOLEN = 0, 1, 2, 3, 4, 7
"""Columns of /proc/stat."""


@dataclass(frozen=True)
class Machine:
    """What all processors together have done since they were started, s."""

    used: float
    stolen: float
    total: float

    @staticmethod
    def now() -> Machine:
        """Read it."""
        ticks = [0.01 * int(item) for item in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
        return Machine(ticks[_USER] + ticks[_NICE] + ticks[_SYSTEM], ticks[_STOLEN], sum(ticks))

    def since(self, before: Machine, own_s: float) -> str:
        """Return the shares since then that others took; ``own_s``: processor time that counts as ours."""
        total = max(self.total - before.total, 1e-9)
        busy = max(self.used - before.used - own_s, 0.0)
        return f"{100 * (self.stolen - before.stolen) / total:3.0f} % stolen, {100 * busy / total:3.0f} % busy"


def run(recording: Path, mode: str, out: Path) -> tuple[dict[str, Any], str]:
    """Return the summary of a run and what the machine did beside it."""
    command = [
        sys.executable,
        "-m",
        "vli_bringup.cli",
        "run",
        str(recording / "bag"),
        "--mode",
        mode,
        "--out",
        str(out),
        "--overwrite",
    ]
    command += ["--calib", str(recording / "calibration.yaml")]
    before, begin_s = Machine.now(), time.monotonic()
    subprocess.run(command, check=True, capture_output=True)
    summary = json.loads((out / "summary.json").read_text())
    # Loading and writing are not in the summary's figure: they take one processor.
    own_s = summary["cpu_s"] + max(time.monotonic() - begin_s - summary["wall_s"], 0.0)
    return summary, Machine.now().since(before, own_s)


def print_stages(timing: Path) -> None:
    """Print what each stage takes; they run beside each other, so that their sum is more than the total."""
    rows = list(csv.DictReader(timing.open()))
    for name in (*STAGES, "total"):
        times = np.array([float(row[f"{name}_ms"]) for row in rows])
        print(f"  {name:<12}{times.mean():7.2f} ms mean{np.percentile(times, 95):8.2f} ms p95{times.max():8.1f} ms max")


def main() -> None:
    """Run, and print a line each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--recording", type=Path, default=DATA, help="directory with bag and calibration.yaml (default: %(default)s)"
    )
    parser.add_argument("--runs", type=int, default=3, help="of each mode (default: %(default)s)")
    parser.add_argument("--modes", nargs="+", choices=BARS, default=list(BARS), help="default: all")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        for _ in range(options.runs):
            for mode in options.modes:
                summary, beside = run(options.recording, mode, Path(directory) / mode)
                times = f"{summary['ms_per_frame_mean']:5.1f} / {summary['ms_per_frame_p95']:5.1f} ms"
                print(f"{mode}: {times} (≤ {BARS[mode]} ms), {summary['realtime_factor']:.2f} × real time; {beside}", flush=True)
        for mode in options.modes:
            print(f"{mode}, the last run:")
            print_stages(Path(directory) / mode / "timing.csv")


if __name__ == "__main__":
    main()
