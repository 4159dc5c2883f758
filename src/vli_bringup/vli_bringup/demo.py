"""``vli demo``: the bag that comes with the project, through the node graph, with figures against its truth."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from vli_bringup import replay
from vli_bringup.evaluation import Sources, evaluate
from vli_bringup.output import SUMMARY
from vli_bringup.report import Evaluation
from vli_common.errors import InputError

RECORDING = Path(__file__).parent / "data" / "bags" / "demo"
"""Written by ``vli simulate``: ``bag``, ``calibration.yaml``, ``truth.tum`` and, where there is room for them, the surface."""

_LATEST = Path("results", "latest")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``vli demo``."""
    parser.add_argument("--out", metavar="DIR", type=Path, help="results (default: results/STAMP, and the link results/latest)")
    parser.add_argument("--overwrite", action="store_true", help="replace the results in DIR")


def run(args: argparse.Namespace) -> int:
    """Replay the demo bag, then say what came out and where it lies; return the code of the replay.

    Raises:
        VliError: the demo bag is not there, or the replay failed.
    """
    code = replay.run(_replay_arguments(RECORDING, args))
    if code == 0:
        print(summarise(RECORDING, args.out or _LATEST))
    return code


def summarise(recording: Path, directory: Path) -> str:
    """Return the figures of a replayed recording and its files, a line each.

    Args:
        recording: with the truth.
        directory: the results.
    """
    surface, seen = (path if path.is_file() else None for path in (recording / "surface.ply", recording / "seen.ply"))
    figures = evaluate(Sources(directory, recording / "truth.tum", surface, seen, None)).figures
    summary = json.loads((directory / SUMMARY).read_text())
    lines = [
        ("camera path", f"{1e2 * figures.live.path_length_m:.1f} cm, {summary['frames_with_pose']} poses"),
        (
            "error of the live poses",
            f"{figures.live.translation_rmse_mm:.2f} mm RMSE, scale {figures.live.scale_error_percent:+.2f} %",
        ),
        *_map_lines(figures),
        ("map points", f"{summary['points']:,}"),
        ("picture", str(directory / "cloud.png")),
        ("map", str(directory / "map.ply")),
        ("poses", str(directory / "trajectory.tum")),
    ]
    return "\n".join(f"{name + ':':<26}{value}" for name, value in lines)


def _map_lines(figures: Evaluation) -> list[tuple[str, str]]:
    lines = []
    if figures.surface is not None and figures.surface.map_point_to_plane_rmse_mm is not None:
        lines.append(("error of the map", f"{figures.surface.map_point_to_plane_rmse_mm:.2f} mm RMSE to the true surface"))
    if figures.completeness is not None:
        lines.append(("completeness", f"{figures.completeness.completeness_percent:.0f} % of what the laser saw"))
    return lines


def _replay_arguments(recording: Path, args: argparse.Namespace) -> argparse.Namespace:
    if not (recording / "calibration.yaml").is_file():
        raise InputError(
            f"the demo bag '{recording}' is not there; make one and scan it: 'vli simulate keyboard --preset smoke --out scene', "
            "'vli replay scene/bag --calib scene/calibration.yaml'"
        )
    parser = argparse.ArgumentParser()
    replay.add_arguments(parser)
    options = ["--out", str(args.out)] if args.out else []
    options += ["--overwrite"] if args.overwrite else []
    arguments = [str(recording / "bag"), "--calib", str(recording / "calibration.yaml"), *options]
    return parser.parse_args(arguments, argparse.Namespace(started_s=args.started_s))
