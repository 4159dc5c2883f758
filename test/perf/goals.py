"""The accuracy that the project sets itself, as a table: figure, goal, measured in each mode, mean over the seeds.

    python test/perf/goals.py [--seeds 1] [--data DIR] [--only keyboard-full ...] [--json F]

Recordings are kept in ``--data`` and used again; the six passes take half an hour to make on two cores, the others two to six
minutes. The recording of another generator in ``../shared/data`` is used where it is there. Starts in motion:
`bench_starts.py`; time: `bench_speed.py`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scenes import measure, recording

SHARED = Path(__file__).resolve().parents[3] / "shared/data"
ODOMETRY, SLAM, NO_IMU, NO_LASER = "vli-odom", "vli-slam", "vl", "vi"
Figures = dict[str, float]


@dataclass(frozen=True)
class Source:
    """Recordings of one kind: the same but for the seed.

    Args:
        text: for the table.
        scene, variant: see ``scenes.recording``; no variant: a recording in ``../shared/data``, which has no seeds.
    """

    text: str
    scene: str
    variant: str = ""

    @property
    def name(self) -> str:
        """Name on the command line."""
        return f"{self.scene}-{self.variant}" if self.variant else self.scene


SHORT = Source("keyboard_short", "keyboard_short")
KEYBOARD = Source("keyboard, 25 s", "keyboard", "short")
PIPE = Source("pipe, 25 s", "pipe", "short")
PART = Source("part, 25 s", "part", "short")
SMOOTH = Source("smooth hand, IMU noise × 5", "keyboard", "smooth")
FULL = Source("six passes", "keyboard", "full")
SOURCES = (SHORT, KEYBOARD, PIPE, PART, SMOOTH, FULL)


@dataclass(frozen=True)
class Goal:
    """One line of the table.

    Args:
        source: what is scanned.
        text: name of the figure.
        key: of the JSON of ``vli eval``.
        most: greatest absolute value, None where the figure is only shown.
        least: smallest value.
        modes: in which it is measured.
    """

    source: Source
    text: str
    key: str
    most: float | None
    least: float = 0.0
    modes: Sequence[str] = (ODOMETRY, SLAM)

    def met(self, value: float) -> bool:
        """Return True where the value, signs off, is within the goal."""
        return self.most is None or self.least <= abs(value) <= self.most


def _accuracy(source: Source, rmse_mm: float, scale_percent: float) -> list[Goal]:
    return [
        Goal(source, "live translation RMSE, mm", "translation_rmse_mm", rmse_mm),
        Goal(source, "scale error, %", "scale_error_percent", scale_percent),
        Goal(source, "NEES of the position", "position_nees", 6.0, 1.0),
    ]


GOALS = [
    *_accuracy(SHORT, 0.09, 0.12),
    *_accuracy(KEYBOARD, 0.12, 0.12),
    *_accuracy(PIPE, 0.12, 0.12),
    *_accuracy(PART, 0.12, 0.12),
    *_accuracy(SMOOTH, 0.24, 0.24),
    *_accuracy(FULL, 0.20, 0.12),
    Goal(FULL, "drift, %", "drift_percent", 0.03),
    Goal(FULL, "absolute drift per pass, %", "absolute_drift_percent", 0.20),
    Goal(FULL, "rotation RMSE, rad", "rotation_rmse_rad", 0.005),
    Goal(FULL, "no IMU: live translation RMSE, mm", "translation_rmse_mm", 2.0, modes=(NO_IMU,)),
    Goal(SMOOTH, "no laser: live translation RMSE, mm", "translation_rmse_mm", None, modes=(NO_LASER,)),
    Goal(SMOOTH, "no laser: scale error, %", "scale_error_percent", None, modes=(NO_LASER,)),
    Goal(KEYBOARD, "no laser: live translation RMSE, mm", "translation_rmse_mm", None, modes=(NO_LASER,)),
    Goal(KEYBOARD, "no laser: scale error, %", "scale_error_percent", None, modes=(NO_LASER,)),
]
MODES = (ODOMETRY, SLAM, NO_IMU, NO_LASER)


def mean_size(values: Sequence[float]) -> float:
    """Return the mean of the absolute values: errors of opposite sign do not make up for each other."""
    return float(np.mean(np.abs(values)))


def row(goal: Goal, measured: Callable[[str], Sequence[Figures]]) -> str:
    """Return one line of the table.

    Args:
        goal: of the line.
        measured: mode → the figures of every recording.
    """
    cells = []
    for mode in MODES:
        runs = measured(mode) if mode in goal.modes else []
        values = [figures[goal.key] for figures in runs if figures.get(goal.key) is not None]
        if not runs:
            cells.append("")
        elif len(values) < len(runs):
            cells.append(f"{len(runs) - len(values)} of {len(runs)} without a figure ✗")
        else:
            mean = mean_size(values)
            cells.append(f"{mean:.3g}{'' if goal.met(mean) else ' ✗'}")
    bounds = "–" if goal.most is None else f"{goal.least:g} to {goal.most:g}" if goal.least else f"≤ {goal.most:g}"
    return f"| {goal.source.text}: {goal.text} | {bounds} | " + " | ".join(cells) + " |"


@dataclass(frozen=True)
class Laboratory:
    """Runs each recording once in each mode.

    Args:
        data: where recordings and results are kept.
        seeds: of the recordings.
        results: (source, mode, seed) → figures, filled on demand.
    """

    data: Path
    seeds: Sequence[int]
    results: dict[str, Figures]

    def measure(self, source: Source, mode: str) -> list[Figures]:
        """Return the figures of all seeds."""
        return [self._once(source, mode, seed) for seed in (self.seeds if source.variant else [0])]

    def _once(self, source: Source, mode: str, seed: int) -> Figures:
        key = f"{source.name} {seed} {mode}"
        if key not in self.results:
            if source.variant:
                self.results[key] = measure(recording(self.data, source.scene, source.variant, seed), mode)
            else:
                self.results[key] = measure(SHARED / source.scene, mode, self.data / source.scene)
        return self.results[key]


def chosen(only: Sequence[str]) -> Iterator[Goal]:
    """Yield the goals of some sources, those whose recording cannot be had left out."""
    for goal in GOALS:
        if goal.source.name in only and (goal.source.variant or (SHARED / goal.source.scene).is_dir()):
            yield goal


def main() -> None:
    """Make what is missing, measure all, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [source.name for source in SOURCES]
    parser.add_argument("--seeds", nargs="+", type=int, default=[1])
    parser.add_argument("--data", type=Path, default=Path("results/scenes"))
    parser.add_argument("--only", nargs="+", choices=names, default=names, metavar="NAME", help=", ".join(names))
    parser.add_argument("--json", type=Path, help="write all figures of all runs here as well")
    args = parser.parse_args()
    laboratory = Laboratory(args.data, args.seeds, {})
    print(f"| seeds {', '.join(map(str, args.seeds))} | goal | " + " | ".join(MODES) + " |")
    print("|---|---|" + "---:|" * len(MODES))
    for goal in chosen(args.only):
        print(row(goal, partial(laboratory.measure, goal.source)), flush=True)
        if args.json:
            args.json.write_text(json.dumps(laboratory.results, indent=1) + "\n")


if __name__ == "__main__":
    main()
