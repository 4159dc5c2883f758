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
    "ms_per_frame_mean": "ms a frame",
}


def measure(recording: Path, mode: str) -> dict[str, float]:
    """Run and evaluate one recording; return the figures of ``vli eval``.

    Args:
        recording: directory written by ``vli simulate``, or one of its form.
        mode: of ``vli run``.
    """
    out, figures = recording / f"run-{mode}", recording / f"run-{mode}.json"
    command = ["run", str(recording / "bag"), "--calib", str(recording / "calibration.yaml"), "--out", str(out), "--overwrite"]
    with contextlib.redirect_stdout(io.StringIO()):
        if vli([*command, "--mode", mode]) != 0:
            return {}
        vli(["eval", str(out), "--truth", str(recording / "truth.tum"), "--json", str(figures)])
    result: dict[str, float] = json.loads(figures.read_text())
    return result


def main() -> None:
    """Make what is missing, measure all, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["keyboard", "pipe", "part"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--preset", default="short", choices=["smoke", "short", "full"])
    parser.add_argument("--data", type=Path, default=Path("results/scenes"))
    parser.add_argument("--mode", default="vli-slam")
    args = parser.parse_args()
    print(f"| {args.mode}, {args.preset} | " + " | ".join(COLUMNS.values()) + " |")
    print("|---|" + "---:|" * len(COLUMNS))
    for scene, seed in itertools.product(args.scenes, args.seeds):
        recording = args.data / f"{scene}-{args.preset}-{seed}"
        if not recording.is_dir():
            vli(["simulate", scene, "--preset", args.preset, "--seed", str(seed), "--out", str(recording)])
        figures = measure(recording, args.mode)
        cells = (f"{figures[key]:.3g}" if isinstance(figures.get(key), float) else str(figures.get(key, "–")) for key in COLUMNS)
        print(f"| {scene} {seed} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
