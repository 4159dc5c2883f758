"""Accuracy on the project's own scenes: simulate, run, evaluate, and print one table.

    python test/perf/scenes.py [--scenes keyboard pipe part] [--seeds 1 2 3] [--preset short] [--data DIR] [--mode vli-slam]

Recordings are kept in ``--data`` and used again; a 25 s one takes two to six minutes to make.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import json
from collections.abc import Sequence
from pathlib import Path

from vli_bringup.cli import main as vli

COLUMNS = {
    "translation_rmse_mm": "RMSE live, mm",
    "final_translation_rmse_mm": "final, mm",
    "scale_error_percent": "scale, %",
    "drift_percent": "drift, %",
    "rotation_rmse_rad": "rotation, rad",
    "map_point_to_plane_rmse_mm": "map to plane, mm",
    "beyond_1mm_percent": "beyond 1 mm, %",
    "completeness_percent": "complete, %",
    "points": "points",
    "poses_share_percent": "poses, %",
    "position_nees": "NEES",
    "ms_per_frame_mean": "ms a frame",
}
VARIANTS: dict[str, Sequence[str]] = {
    "smoke": ("--preset", "smoke"),
    "short": ("--preset", "short"),
    "full": ("--preset", "full"),
    "smooth": ("--preset", "short", "--tremor", "0", "--imu-noise", "5"),
}
"""Name → how to simulate: the presets, and a smooth hand with a bad IMU."""


def recording(data: Path, scene: str, variant: str, seed: int) -> Path:
    """Return the directory of a recording, which is made where it is missing.

    Args:
        data: where recordings are kept.
        scene: of ``vli simulate``.
        variant: of :data:`VARIANTS`.
        seed: of everything that is random.
    """
    directory = data / f"{scene}-{variant}-{seed}"
    if not directory.is_dir():
        vli(["simulate", scene, *VARIANTS[variant], "--seed", str(seed), "--out", str(directory)])
    return directory


def measure(directory: Path, mode: str, out: Path | None = None) -> dict[str, float]:
    """Run and evaluate one recording; return the figures of ``vli eval``, none where it never tracked.

    Args:
        directory: written by ``vli simulate``, or one of its form.
        mode: of ``vli run``.
        out: gets the results; the recording's own directory by default.
    """
    results = (out or directory) / f"run-{mode}"
    figures = results.with_suffix(".json")
    results.parent.mkdir(parents=True, exist_ok=True)
    command = [
        "run",
        str(directory / "bag"),
        "--calib",
        str(directory / "calibration.yaml"),
        "--out",
        str(results),
        "--overwrite",
    ]
    with contextlib.redirect_stdout(io.StringIO()):
        if vli([*command, "--mode", mode]) != 0:
            return {}
        vli(["eval", str(results), "--truth", str(directory / "truth.tum"), "--json", str(figures)])
    result: dict[str, float] = json.loads(figures.read_text())
    return result


def main() -> None:
    """Make what is missing, measure all, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["keyboard", "pipe", "part"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--preset", default="short", choices=list(VARIANTS))
    parser.add_argument("--data", type=Path, default=Path("results/scenes"))
    parser.add_argument("--mode", default="vli-slam")
    args = parser.parse_args()
    print(f"| {args.mode}, {args.preset} | " + " | ".join(COLUMNS.values()) + " |")
    print("|---|" + "---:|" * len(COLUMNS))
    for scene, seed in itertools.product(args.scenes, args.seeds):
        figures = measure(recording(args.data, scene, args.preset, seed), args.mode)
        cells = (f"{figures[key]:.3g}" if isinstance(figures.get(key), float) else str(figures.get(key, "–")) for key in COLUMNS)
        print(f"| {scene} {seed} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
