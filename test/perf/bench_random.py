"""Scenes that nobody has looked at: everything is drawn from the seed, simulated, run and compared with the truth; one row each.

    python test/perf/bench_random.py [--ranges usual|wide] [--first 7001] [--count 20] [--data DIR] [--mode vli-slam]

``usual`` is how a scanner is held, 25 to 50 mm away; ``wide`` goes to its limits: 22 to 100 mm, stronger and no tremor, other
image sizes. Recordings, 8 to 12 s each and two minutes to make, are kept in ``--data`` and used again. A figure that stands out
is a case to take apart, with `bench_estimator.py` for one.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import random
from dataclasses import dataclass
from pathlib import Path

from scenes import measure

from vli_bringup.cli import main as vli

COLUMNS = {
    "translation_rmse_mm": "RMSE live, mm",
    "scale_error_percent": "scale, %",
    "position_nees": "NEES",
    "map_point_to_plane_rmse_mm": "map to plane, mm",
    "completeness_percent": "complete, %",
    "poses_share_percent": "poses, %",
}
SCENES = ("keyboard", "pipe", "part")


@dataclass(frozen=True)
class Ranges:
    """What is drawn, in this order: options of ``vli simulate`` and their values; the share of starts in motion."""

    options: dict[str, tuple[object, ...]]
    in_motion: float

    def draw(self, seed: int) -> tuple[str, list[str]]:
        """Return scene and options of a seed."""
        rng = random.Random(seed)
        scene = rng.choice(SCENES)
        drawn = [f"--{name}={rng.choice(values)}" for name, values in self.options.items()]
        return scene, drawn + ["--no-rest"] * (rng.random() < self.in_motion)


RANGES = {
    "usual": Ranges(
        {
            "duration": (8, 10, 12),
            "lens": ("radtan", "equidistant", "none"),
            "stripe-angle": (0, 20, 45, 70, 90, 120, 150),
            "laser-colour": ("red", "blue"),
            "encoding": ("jpeg", "bayer", "rgb", "mono"),
            "tremor": (0.5, 1, 1, 2),
            "imu-noise": (1, 1, 3),
            "speed": (0.012, 0.015, 0.02, 0.025),
            "distance": (0.025, 0.03, 0.04, 0.05),
        },
        0.3,
    ),
    "wide": Ranges(
        {
            "distance": (0.022, 0.03, 0.06, 0.08, 0.1),
            "duration": (8, 10),
            "lens": ("radtan", "equidistant", "none"),
            "stripe-angle": (0, 30, 60, 90, 135),
            "encoding": ("jpeg", "bayer", "mono"),
            "tremor": (0, 0.3, 1, 3),
            "sway": (0, 1, 2),
            "imu-noise": (0, 1, 5),
            "speed": (0.006, 0.015, 0.03, 0.045),
            "resolution": ("640x480", "640x480", "1280x960", "480x360"),
        },
        0.4,
    ),
}


def recording(data: Path, ranges: str, seed: int) -> tuple[Path | None, str]:
    """Return the directory of a recording, made where it is missing, and what it is; no directory where it cannot be made."""
    scene, options = RANGES[ranges].draw(seed)
    directory = data / f"{ranges}-{seed}"
    is_made = directory.is_dir()
    if not is_made:
        with contextlib.redirect_stdout(io.StringIO()):
            is_made = vli(["simulate", scene, "--preset", "smoke", "--seed", str(seed), "--out", str(directory), *options]) == 0
    return directory if is_made else None, " ".join([scene, *(option.removeprefix("--") for option in options)])


def main() -> None:
    """Make what is missing, measure all, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ranges", choices=RANGES, default="usual")
    parser.add_argument("--first", type=int, default=7001, help="seed (default: %(default)s)")
    parser.add_argument("--count", type=int, default=20, help="default: %(default)s")
    parser.add_argument("--data", type=Path, default=Path("results/random"))
    parser.add_argument("--mode", default="vli-slam")
    args = parser.parse_args()
    print(f"| {args.mode} | " + " | ".join(COLUMNS.values()) + " | |")
    print("|---|" + "---:|" * len(COLUMNS) + "---|")
    for seed in range(args.first, args.first + args.count):
        directory, text = recording(args.data, args.ranges, seed)
        figures = measure(directory, args.mode) if directory is not None else {}
        cells = (f"{figures[key]:.3g}" if isinstance(figures.get(key), float) else str(figures.get(key, "–")) for key in COLUMNS)
        print(f"| {seed} | " + " | ".join(cells) + f" | {text} |", flush=True)


if __name__ == "__main__":
    main()
