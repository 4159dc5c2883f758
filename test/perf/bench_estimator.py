"""Which stage limits: one after the other they get the truth in place of what they measure; what is left of the error is printed.

    python test/perf/bench_estimator.py [RECORDING ...] [--rows NAME ...] [--duration 25] [--json F]

RECORDING (default ``../shared/data/keyboard_short``) holds ``bag``, ``calibration.yaml``, ``truth.tum`` and ``surface.ply``, as
`vli simulate` writes them. Figures are those of `vli eval`; NEES: 3 is consistent. A row that is much better than the first
names the stage that limits; the last rows show what remains when all that is measured is true.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from ground_truth import Truth
from injection import KNOWN_START, Injection, experiment

from vli_bringup.evaluation import Sources, evaluate
from vli_bringup.pipeline import Pipeline
from vli_bringup.recorder import Recorder
from vli_bringup.report import Value, as_dict
from vli_bringup.settings import load_settings
from vli_bringup.warm_up import warm_up
from vli_common.errors import InputError
from vli_common.types import EncodedImage, ImuSample, Mode
from vli_driver.bag import BagReader, BagTopics
from vli_mapping.store import write_ply

DATA = Path(__file__).resolve().parents[3] / "shared/data/keyboard_short"


@dataclass(frozen=True)
class Row:
    """One experiment: what is true in it, and the mode."""

    what: Injection
    mode: Mode = Mode.VLI_ODOM


_MEASURED = Injection.STRIPE | Injection.TRACKS | Injection.IMU | Injection.START
ROWS = {
    "measured, odometry": Row(Injection.NOTHING),
    "true stripes": Row(Injection.STRIPE),
    "true tracks": Row(Injection.TRACKS),
    "true tracks and stripes": Row(Injection.TRACKS | Injection.STRIPE),
    "IMU without bias": Row(Injection.BIAS),
    "ideal IMU": Row(Injection.IMU),
    "true start": Row(Injection.START),
    "ideal IMU, true start": Row(Injection.IMU | Injection.START),
    "ideal IMU, true start and tracks": Row(Injection.IMU | Injection.START | Injection.TRACKS),
    "all true": Row(_MEASURED),
    "measured, with the map": Row(Injection.NOTHING, Mode.VLI_SLAM),
    "map from true poses": Row(Injection.MAPPING_POSES, Mode.VLI_SLAM),
    "map from true poses and stripes": Row(Injection.MAPPING_POSES | Injection.STRIPE, Mode.VLI_SLAM),
    "all true, with the map": Row(_MEASURED | Injection.MAPPING_POSES, Mode.VLI_SLAM),
    "measured, no IMU": Row(Injection.NOTHING, Mode.VL),
    "true tracks, no IMU": Row(Injection.TRACKS, Mode.VL),
    "true stripes, no IMU": Row(Injection.STRIPE, Mode.VL),
}
COLUMNS = {
    "translation_rmse_mm": ("RMSE live, mm", ".3f"),
    "final_translation_rmse_mm": ("final, mm", ".3f"),
    "scale_error_percent": ("scale, %", "+.3f"),
    "rotation_rmse_rad": ("rotation, rad", ".4f"),
    "drift_percent": ("drift, %", ".3f"),
    "map_point_to_plane_rmse_mm": ("map to plane, mm", ".3f"),
    "position_nees": ("NEES", ".2f"),
    "poses_share_percent": ("poses, %", ".0f"),
}


def measure(directory: Path, items: list[EncodedImage | ImuSample], truth: Truth, row: Row) -> dict[str, Value]:
    """Run one experiment in memory; return the figures of ``vli eval``, none where it never tracked.

    Args:
        directory: of the recording, for the files of its truth.
        items: of its bag.
        truth: the same, as the stages take it.
        row: the experiment.
    """
    settings = load_settings(None, KNOWN_START if Injection.START in row.what else ())
    prepared = experiment(items, truth, settings, row.mode, row.what)
    pipeline = Pipeline(prepared.stages, row.mode)
    recorder = Recorder(truth.calibration)
    for item in prepared.items:
        recorder.add(pipeline.push(item))
    recorder.add(pipeline.flush())
    with tempfile.TemporaryDirectory() as out:
        recorder.write(Path(out))
        write_ply(Path(out) / "map.ply", pipeline.stages.mapper.map.cloud())
        passes = directory / "passes.json"
        sources = Sources(
            Path(out), directory / "truth.tum", directory / "surface.ply", None, passes if passes.is_file() else None
        )
        try:
            return as_dict(evaluate(sources).figures)
        except InputError as error:
            print(f"bench_estimator: {error}", file=sys.stderr)
            return {}


def cells(figures: dict[str, Value]) -> str:
    """Return one line of the table, without its name."""
    values = ((figures.get(key), form) for key, (_, form) in COLUMNS.items())
    return " | ".join("–" if value is None else format(value, form) for value, form in values)


def main() -> None:
    """Print one table a recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, nargs="*", default=[DATA])
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS), metavar="NAME", help=", ".join(ROWS))
    parser.add_argument("--duration", type=float, help="seconds from the start of each recording (default: all)")
    parser.add_argument("--json", type=Path, help="write all figures here as well")
    args = parser.parse_args()
    warm_up()
    everything: dict[str, dict[str, dict[str, Value]]] = {}
    for directory in args.recordings:
        items = list(BagReader(directory / "bag", BagTopics(), 0.0, args.duration))
        truth = Truth.load(directory)
        print(f"\n| {directory.name} | " + " | ".join(name for name, _ in COLUMNS.values()) + " |")
        print("|---|" + "---:|" * len(COLUMNS))
        everything[directory.name] = {}
        for name in args.rows:
            figures = everything[directory.name][name] = measure(directory, items, truth, ROWS[name])
            print(f"| {name} | {cells(figures)} |", flush=True)
    if args.json:
        args.json.write_text(json.dumps(everything, indent=1) + "\n")


if __name__ == "__main__":
    main()
