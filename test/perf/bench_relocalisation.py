"""Put down anywhere on what is mapped: how soon the scanner finds its place in the map of an earlier scan, and how well.

    python test/perf/bench_relocalisation.py [RECORDING] [--map 13] [--tries 20] [--seed 1] [--scan DIR]

The first ``--map`` seconds of a recording (a directory with ``bag``, ``calibration.yaml`` and ``truth.tum``) make the map; each
try is a new session that begins at a random time after that, where the true path runs over the mapped part, and is given that map
as ``mapping.prior_map``. One row a try, then the worst. The time counts from the first pose; the error is the largest of the live
positions in the second after the place was found; on a wrong key it is 19 mm.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vli_bringup.arguments import bag_topics
from vli_bringup.cli import main as vli
from vli_bringup.pipeline import Pipeline, Stages
from vli_bringup.recorder import Recorder
from vli_bringup.settings import Settings, load_settings
from vli_bringup.tum import Trajectory, read_tum
from vli_bringup.warm_up import warm_up
from vli_common.arrays import FloatArray, IntArray
from vli_common.calibration import load_calibration
from vli_common.geometry import align, transform
from vli_common.types import NANOSECONDS, Mode, WindowPoses
from vli_driver.bag import BagReader

DATA = Path(__file__).resolve().parents[3] / "shared/data/keyboard_short"
MAX_S, MAX_MM = 2.0, 0.5
_WATCHED_S, _AFTER_S = 8.0, 1.0
_MAPPED_M = 0.015
"""A true place this near to the path of the map sees what is mapped."""
_ARMS = np.vstack([np.zeros(3), 0.03 * np.eye(3)])
"""Points of a pose that are aligned, so that orientation counts."""


@dataclass(frozen=True)
class Try:
    """One start: where it was cut, seconds from the first pose to its place in the map, largest error in the second after."""

    at_s: float
    after_s: float
    error_mm: float
    doubts: str

    @property
    def good(self) -> bool:
        """True where the place is found soon enough, and is the right one."""
        return self.after_s <= MAX_S and self.error_mm <= MAX_MM


def measure(recording: Path, at_s: float, settings: Settings, T_truth_map: FloatArray, truth: Trajectory) -> Try:
    """Run the recording from ``at_s`` on until a second after it has found its place."""
    calibration = load_calibration(recording / "calibration.yaml", Mode.VLI_SLAM)
    pipeline, recorder = Pipeline(Stages.create(calibration, settings, Mode.VLI_SLAM), Mode.VLI_SLAM), Recorder(calibration)
    first_ns = found_ns = None
    for item in BagReader(recording / "bag", bag_topics(settings, Mode.VLI_SLAM), at_s, _WATCHED_S):
        events = pipeline.push(item)
        recorder.add(events)
        first_ns = first_ns or next(iter(recorder.live), None)
        if found_ns is None and any(isinstance(event, WindowPoses) and event.placement for event in events):
            found_ns = max(recorder.live)
        if found_ns is not None and max(recorder.live) > found_ns + _AFTER_S * NANOSECONDS:
            break
    doubts = {name: count for name, count in pipeline.stages.mapper.counters.values.items() if name.startswith("relocalisation")}
    text = ", ".join(f"{name.removeprefix('relocalisation_')} {count}" for name, count in doubts.items())
    if first_ns is None or found_ns is None:
        return Try(at_s, np.inf, np.inf, text)
    stamps = np.array([stamp for stamp in recorder.live if stamp > found_ns], np.int64)
    poses = np.stack([recorder.live[int(stamp)] for stamp in stamps])
    off = transform(T_truth_map, poses[:, :3, 3]) - _at(truth, stamps)[:, :3, 3]
    return Try(at_s, (found_ns - first_ns) / NANOSECONDS, 1e3 * float(np.linalg.norm(off, axis=1).max()), text)


def make_map(recording: Path, duration_s: float, out: Path) -> None:
    """Scan the first seconds of the recording."""
    command = ["run", str(recording / "bag"), "--calib", str(recording / "calibration.yaml"), "--out", str(out)]
    if code := vli([*command, "--duration", f"{duration_s}"]):
        raise SystemExit(code)


def place_of(scan: Path, truth: Trajectory) -> FloatArray:
    """Return where the map of a scan is in the frame of the truth, (4, 4)."""
    estimate = read_tum(scan / "trajectory_final.tum")
    source, target = (
        np.concatenate([transform(T, _ARMS) for T in poses]) for poses in (estimate.poses, _at(truth, estimate.stamps_ns))
    )
    return align(source, target)[0]


def _at(truth: Trajectory, stamps: IntArray) -> FloatArray:
    """Return the true poses (N, 4, 4) nearest to stamps (N,)."""
    after = np.clip(np.searchsorted(truth.stamps_ns, stamps), 1, len(truth) - 1)
    closer = stamps - truth.stamps_ns[after - 1] < truth.stamps_ns[after] - stamps
    return truth.poses[after - closer]


def _times(truth: Trajectory, mapped_s: float, count: int, rng: np.random.Generator) -> list[float]:
    """Return seconds after the start of the recording from which on the path runs over the mapped part."""
    seconds = (truth.stamps_ns - truth.stamps_ns[0]) / NANOSECONDS
    path = truth.positions[seconds < mapped_s][::10]
    near = np.array([np.linalg.norm(path - position, axis=1).min() < _MAPPED_M for position in truth.positions])
    far = np.concatenate([[0], np.cumsum(~near)])
    end = np.searchsorted(seconds, seconds + _WATCHED_S / 2)
    possible = (seconds > mapped_s) & (seconds < seconds[-1] - _WATCHED_S) & (far[end] == far[: len(seconds)])
    if not possible.any():
        raise SystemExit(f"no path over the first '{mapped_s}' s of the recording in the rest of it; choose another --map")
    return sorted(rng.choice(seconds[possible], count).round(3).tolist())


def main() -> None:
    """Make the map, try all starts, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", nargs="?", type=Path, default=DATA)
    parser.add_argument("--map", type=float, default=13.0, help="seconds of the recording that make the map")
    parser.add_argument("--tries", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scan", type=Path, help="results of 'vli run --duration MAP' that are there already")
    args = parser.parse_args()
    truth = read_tum(args.recording / "truth.tum")
    with tempfile.TemporaryDirectory() as directory:
        scan = args.scan or Path(directory) / "scan"
        if args.scan is None:
            make_map(args.recording, args.map, scan)
        settings = load_settings(None, [])
        settings = replace(settings, mapping=replace(settings.mapping, prior_map=str(scan / "map.vli")))
        T_truth_map = place_of(scan, truth)
        warm_up()
        print("| start at, s | found after, s | error, mm | |\n|---|---|---|---|")
        tries = []
        for at_s in _times(truth, args.map, args.tries, np.random.default_rng(args.seed)):
            one = measure(args.recording, at_s, settings, T_truth_map, truth)
            tries.append(one)
            print(f"| {one.at_s:.3f} | {one.after_s:.2f} | {one.error_mm:.3f} | {one.doubts} |", flush=True)
    wrong = sum(np.isfinite(one.error_mm) and one.error_mm > 5.0 for one in tries)
    worst = f"{max(one.after_s for one in tries):.2f} | {max(one.error_mm for one in tries):.3f}"
    print(f"| {sum(one.good for one in tries)} of {len(tries)} good, {wrong} elsewhere; worst | {worst} | |")


if __name__ == "__main__":
    main()
