"""Starts cut into the motion, as ``--start`` does: how soon each tracks, and how well it holds; one row a start, then the worst.

    python test/perf/bench_starts.py [RECORDING ...] [--starts 20] [--seed 1] [--mode vli-odom] [--rest 1.5]

A recording is a directory with ``bag``, ``calibration.yaml`` and ``truth.tum``. The starts are shared out among the recordings.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vli_bringup.cli import main as vli
from vli_bringup.trajectory_metrics import associate, trajectory_errors, trajectory_figures
from vli_bringup.tum import Trajectory, read_tum
from vli_common.types import NANOSECONDS, TrackingState

DATA = Path(__file__).resolve().parents[3] / "shared/data/keyboard_short"
START_S, HOLD_S = 1.5, 7.0
"""A start has to track within the first, and is then watched for the second."""
MAX_RMSE_MM, MAX_SCALE_PERCENT = 0.2, 0.5
FRAME_S = 1.0 / 30.0


@dataclass(frozen=True)
class Start:
    """One start: where it was cut, seconds until tracking (infinite: never), share of the poses after, RMSE, scale error."""

    at_s: float
    after_s: float
    share_percent: float
    rmse_mm: float
    scale_percent: float
    reason: str

    @property
    def good(self) -> bool:
        """True where it tracks soon enough, without a gap, and truly."""
        exact = self.rmse_mm <= MAX_RMSE_MM and abs(self.scale_percent) <= MAX_SCALE_PERCENT
        return self.after_s <= START_S and self.share_percent > 99.0 and exact


def measure(recording: Path, at_s: float, mode: str) -> Start:
    """Run the recording from ``at_s`` on and compare what it tracks with the truth."""
    with tempfile.TemporaryDirectory() as directory:
        out = Path(directory) / "run"
        command = ["run", str(recording / "bag"), "--calib", str(recording / "calibration.yaml"), "--out", str(out)]
        window = ["--start", f"{at_s:.3f}", "--duration", f"{START_S + HOLD_S + 0.5}", "--mode", mode]
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            code = vli([*command, *window])
        states = json.loads((out / "summary.json").read_text())["states"]
        estimate = read_tum(out / "trajectory.tum") if code == 0 else None
    began = states[0][0]
    tracked = next(((stamp, reason) for stamp, state, reason in states if state == TrackingState.TRACKING.value), None)
    if tracked is None or estimate is None:
        return Start(at_s, np.inf, 0.0, np.inf, np.inf, states[-1][2])
    held = estimate.stamps_ns <= (tracked[0] + HOLD_S) * NANOSECONDS
    share = 100.0 * min(1.0, np.count_nonzero(held) * FRAME_S / HOLD_S)
    return Start(at_s, tracked[0] - began, share, *_errors(estimate, held, read_tum(recording / "truth.tum")), tracked[1])


def _errors(estimate: Trajectory, held: np.ndarray, truth: Trajectory) -> tuple[float, float]:
    """Return translation RMSE (mm) and scale error (%) of the poses ``held``."""
    pairs = associate(Trajectory(estimate.stamps_ns[held], estimate.poses[held]), truth)
    figures = trajectory_figures(pairs, trajectory_errors(pairs, np.eye(4)), truth, np.empty((0, 2), np.int64))
    return figures.translation_rmse_mm, figures.scale_error_percent


def _times(recording: Path, count: int, rest_s: float, rng: np.random.Generator) -> list[float]:
    """Return seconds after the start of the recording, all in motion and with enough left to watch."""
    stamps = read_tum(recording / "truth.tum").stamps_ns
    last_s = float(stamps[-1] - stamps[0]) / NANOSECONDS - START_S - HOLD_S - 0.5
    return sorted(rng.uniform(rest_s, last_s, count).round(3).tolist())


def main() -> None:
    """Measure all starts, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path, default=[DATA])
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--mode", default="vli-odom")
    parser.add_argument("--rest", type=float, default=1.5, help="seconds at rest at the beginning of a recording")
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    counts = [len(share) for share in np.array_split(np.arange(args.starts), len(args.recordings))]
    print(f"| {args.mode} | start at, s | tracks after, s | poses, % | RMSE, mm | scale, % | |")
    print("|---|---|---|---|---|---|---|")
    starts: list[Start] = []
    for recording, count in zip(args.recordings, counts, strict=True):
        for at_s in _times(recording, count, args.rest, rng):
            start = measure(recording, at_s, args.mode)
            starts.append(start)
            figures = f"{start.after_s:.2f} | {start.share_percent:.0f} | {start.rmse_mm:.3f} | {start.scale_percent:+.2f}"
            print(f"| {recording.name} | {start.at_s:.3f} | {figures} | {start.reason if not start.good else ''} |", flush=True)
    worst = [max(values) for values in zip(*((s.after_s, s.rmse_mm, abs(s.scale_percent)) for s in starts), strict=True)]
    good = sum(start.good for start in starts)
    print(f"| {good} of {len(starts)} good; worst | | {worst[0]:.2f} | | {worst[1]:.3f} | {worst[2]:.2f} | |")


if __name__ == "__main__":
    main()
