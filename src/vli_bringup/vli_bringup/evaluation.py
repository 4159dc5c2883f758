"""``vli eval``: compare the output of ``vli run`` with the truth: Tables I and II of the paper, JSON, plots."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vli_bringup.consistency import COVARIANCES, ConsistencyFigures, consistency_figures, read_covariances
from vli_bringup.evaluation_data import has_colour, number, read_cloud, read_json, read_passes, read_surface
from vli_bringup.map_metrics import (
    CompletenessFigures,
    SurfaceDistances,
    SurfaceFigures,
    completeness_figures,
    nearest_map_points,
    surface_distances,
    surface_figures,
)
from vli_bringup.output import CONFIG, SUMMARY
from vli_bringup.report import Evaluation, RunFigures, as_dict, as_text
from vli_bringup.settings import load_settings
from vli_bringup.trajectory_metrics import (
    Association,
    TrajectoryErrors,
    align_poses,
    associate,
    poses_share,
    trajectory_errors,
    trajectory_figures,
)
from vli_bringup.tum import Trajectory, read_tum
from vli_common.arrays import BoolArray, Float32Array, FloatArray, IntArray
from vli_common.errors import InputError, OutputError
from vli_common.geometry import transform
from vli_common.types import PointCloud

STARTUP_S = 4.0
_NEXT_TO_TRUTH = {"surface": "surface.ply", "seen": "seen.ply", "passes": "passes.json"}


@dataclass(frozen=True, slots=True)
class Sources:
    """Where the inputs are; None where one is not given and not there."""

    run: Path
    truth: Path
    surface: Path | None
    seen: Path | None
    passes: Path | None


@dataclass(frozen=True, slots=True)
class MapResult:
    """The map in the frame of the truth, with what the plots show of it; None where the input for it was not there.

    Args:
        points: (N, 3), metres.
        distances: of the points to the surface.
        seen: (M, 3), what the laser saw.
        covered: (M,), where the map has it.
    """

    points: FloatArray
    distances: SurfaceDistances | None
    seen: Float32Array | None
    covered: BoolArray | None


@dataclass(frozen=True, slots=True)
class Result:
    """Figures, what the plots are drawn from, and what is to be said of them."""

    figures: Evaluation
    live: TrajectoryErrors
    final: TrajectoryErrors | None
    passes_ns: IntArray
    map: MapResult | None
    notes: tuple[str, ...] = ()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``vli eval``."""
    beside = "default: '{}' next to the truth, where there is one"
    parser.add_argument("directory", metavar="DIR", type=Path, help="output of 'vli run' or 'vli replay'")
    parser.add_argument("--truth", metavar="T", type=Path, required=True, help="true camera poses (TUM)")
    parser.add_argument(
        "--surface", metavar="M", type=Path, help=f"true surface, triangle mesh, PLY in metres ({beside.format('surface.ply')})"
    )
    parser.add_argument("--seen", metavar="S", type=Path, help=f"what the laser saw, PLY cloud ({beside.format('seen.ply')})")
    parser.add_argument("--passes", metavar="P", type=Path, help=f"start and end of each pass ({beside.format('passes.json')})")
    parser.add_argument("--json", metavar="F", type=Path, help="write the figures here as well")
    parser.add_argument(
        "--poses-from",
        metavar="S",
        type=float,
        default=STARTUP_S,
        help="count frames without a pose from here on, seconds (default: %(default)s)",
    )


def run(args: argparse.Namespace) -> int:
    """Evaluate, print the tables, write ``DIR/eval/`` and the JSON file; return 0.

    Raises:
        InputError: an input is missing or unusable, or run and truth do not overlap in time.
        OutputError: the report cannot be written.
    """
    sources = find_sources(args)
    result = evaluate(sources, args.poses_from)
    text = as_text(result.figures)
    _write(result, text, args.directory / "eval", args.json)
    found = [getattr(sources, name) for name in _NEXT_TO_TRUTH if getattr(args, name) is None]
    sys.stdout.write(text)
    for note in (
        *(f"used '{path}', next to the truth" for path in found if path is not None),
        *result.notes,
        f"report and plots are in '{args.directory / 'eval'}'",
    ):
        sys.stderr.write(f"vli eval: {note}\n")
    return 0


def find_sources(args: argparse.Namespace) -> Sources:
    """Return the inputs as given, else those that stand next to the truth.

    Raises:
        InputError: DIR is not the output of a run.
    """
    if not (args.directory / "trajectory.tum").is_file():
        raise InputError(
            f"'{args.directory}' holds no 'trajectory.tum', expected the output of 'vli run BAG --calib C --out DIR'"
        )
    paths: dict[str, Path | None] = {}
    for name, file_name in _NEXT_TO_TRUTH.items():
        paths[name] = getattr(args, name)
        beside = args.truth.parent / file_name
        if paths[name] is None and beside.is_file():
            paths[name] = beside
    return Sources(args.directory, args.truth, **paths)


def evaluate(sources: Sources, poses_from_s: float = STARTUP_S) -> Result:
    """Compare a run with its truth.

    Raises:
        InputError: an input is missing or unusable, or run and truth do not overlap in time.
    """
    truth = read_tum(sources.truth)
    passes = read_passes(sources.passes) if sources.passes else np.empty((0, 2), dtype=np.int64)
    notes: list[str] = []
    live = read_tum(sources.run / "trajectory.tum")
    live_pairs = associate(live, truth)
    final_pairs = _final_pairs(sources.run, truth, notes)
    reference = final_pairs or live_pairs
    T_truth_map = align_poses(reference.estimate, reference.truth)

    def figures(pairs: Association) -> tuple[TrajectoryErrors, Any]:
        errors = trajectory_errors(pairs, T_truth_map)
        return errors, trajectory_figures(pairs, errors, truth, passes)

    live_errors, live_figures = figures(live_pairs)
    final_errors, final_figures = figures(final_pairs) if final_pairs else (None, None)
    cloud = _read_map(sources.run, notes)
    if cloud is not None and sources.seen:
        _note_compensation(sources.run, notes)
    mapped, surface, completeness = _compare_map(cloud, T_truth_map, sources)
    share = poses_share(live.stamps_ns, truth.stamps_ns, poses_from_s)
    run_figures = _run_figures(sources.run, share, poses_from_s, None if cloud is None else len(cloud))
    consistency = _consistency(sources.run, live_pairs)
    figures_of_run = Evaluation(run_figures, live_figures, final_figures, surface, completeness, consistency)
    return Result(figures_of_run, live_errors, final_errors, passes, mapped, tuple(notes))


def _consistency(directory: Path, pairs: Association) -> ConsistencyFigures:
    path = directory / COVARIANCES
    return consistency_figures(pairs, *read_covariances(path)) if path.is_file() else ConsistencyFigures()


def _final_pairs(directory: Path, truth: Trajectory, notes: list[str]) -> Association | None:
    path = directory / "trajectory_final.tum"
    if path.is_file():
        return associate(read_tum(path), truth)
    notes.append(f"'{path}' does not exist: the live trajectory aligns rotation and map")
    return None


def _read_map(directory: Path, notes: list[str]) -> PointCloud | None:
    path = directory / "map.ply"
    if path.is_file():
        return read_cloud(path)
    notes.append(f"'{path}' does not exist: no figures of a map")
    return None


def _note_compensation(directory: Path, notes: list[str]) -> None:
    """Note that colours which the light was taken out of are not those that were seen."""
    path = directory / CONFIG
    if path.is_file() and load_settings(path).mapping.colour == "compensated":
        notes.append(
            "the light is taken out of the map's colours: for a figure against the colours as seen, run with --colour lit"
        )


def _compare_map(
    cloud: PointCloud | None, T_truth_map: FloatArray, sources: Sources
) -> tuple[MapResult | None, SurfaceFigures | None, CompletenessFigures | None]:
    """Return the map in the frame of the truth and its figures, each where the input for it is there."""
    surface = read_surface(sources.surface) if sources.surface else None
    seen = read_cloud(sources.seen) if sources.seen else None
    if cloud is None:
        return None, None, None
    points = transform(T_truth_map, cloud.points.astype(np.float64))
    distances = surface_distances(points, surface) if surface is not None else None
    covered = figures = None
    if seen is not None and len(seen):
        covered, nearest = nearest_map_points(seen.points.astype(np.float64), points)
        coloured = has_colour(seen) and has_colour(cloud)
        colours = (seen.colours[covered], cloud.colours[nearest[covered]]) if coloured else None
        figures = completeness_figures(covered, colours)
    mapped = MapResult(points, distances, None if seen is None else seen.points, covered)
    return mapped, surface_figures(distances) if distances and len(points) else None, figures


def _run_figures(directory: Path, share: float | None, from_s: float, points: int | None) -> RunFigures:
    path = directory / SUMMARY
    summary = read_json(path, "summary") if path.is_file() else {}
    timing = {key: number(summary, key) for key in ("ms_per_frame_mean", "ms_per_frame_p95", "realtime_factor")}
    return RunFigures(None if share is None else 100 * share, from_s, points, **timing)


def _write(result: Result, text: str, directory: Path, json_path: Path | None) -> None:
    """Write the report as text, JSON and plots."""
    from vli_bringup.plots import write_plots

    figures = json.dumps(as_dict(result.figures), indent=1) + "\n"
    try:
        directory.mkdir(exist_ok=True)
        (directory / "report.md").write_text(text, encoding="utf-8")
        for path in filter(None, (directory / "figures.json", json_path)):
            path.write_text(figures, encoding="utf-8")
        write_plots(result, directory)
    except OSError as error:
        raise OutputError(f"the report cannot be written ({error}), expected a directory that can be written to") from error
