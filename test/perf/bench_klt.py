"""Tracks against exact truth: lag and scatter by age, lost tracks, time a frame; plain Lucas–Kanade, normalised, with alignment.

    python test/perf/bench_klt.py [RECORDING] [--frames 300]

RECORDING (default ``../shared/data/keyboard_short``) holds ``bag``, ``calibration.yaml``, ``truth.tum`` and ``surface.ply``, as
`vli simulate` writes them. The truth of a track is the surface point that its first pixel sees, projected into the later frames.
*Lag* is the error along the true displacement, in % of it (negative: behind); *scatter* the RMS per axis of what remains. A patch
across a depth edge has no single motion: such tracks are listed apart. Times are of the processor, one thread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from ground_truth import Truth

from vli_common.arrays import BoolArray, FloatArray
from vli_common.calibration import Calibration, load_calibration
from vli_common.types import Exposure, FrontEndOutput, Image, ImuSample, Mode, TrackFlag
from vli_driver.bag import BagReader
from vli_driver.decode import decode
from vli_driver.demux import Demultiplexer
from vli_frontend.config import FrontEndConfig
from vli_frontend.frontend import FrontEnd
from vli_frontend.warm_up import warm_up

DATA = Path(__file__).resolve().parents[3] / "shared/data/keyboard_short"
AGES = (1, 10, 30)
_RECIPE = FrontEndConfig()
TRACKERS = {
    "plain LK": replace(_RECIPE, klt=replace(_RECIPE.klt, alignment=False, normalisation_px=1, pyramid_levels=3)),
    "LK, normalised": replace(_RECIPE, klt=replace(_RECIPE.klt, alignment=False)),
    "recipe": _RECIPE,
}


@dataclass(frozen=True)
class Track:
    """One patch through the frames: the frame of its birth, ids and pixels (M, 2)."""

    birth: int
    pixels: FloatArray
    sigma: FloatArray


def long_frames(directory: Path, calibration: Calibration, frames: int) -> Iterator[Image | ImuSample]:
    """Yield IMU samples and ``frames`` long frames, decoded."""
    demultiplexer, count = Demultiplexer(), 0
    for item in BagReader(directory / "bag"):
        if isinstance(item, ImuSample):
            yield item
            continue
        for exposure, image in demultiplexer.push(decode(item)):
            if exposure is Exposure.LONG:
                yield image
                count += 1
        if count >= frames:
            return


def run(
    items: list[Image | ImuSample], calibration: Calibration, config: FrontEndConfig
) -> tuple[list[FrontEndOutput], FloatArray]:
    """Return what the front end says, and its milliseconds for each long frame (its IMU samples included)."""
    front_end, outputs, spent, times = FrontEnd(calibration, config, Mode.VLI_SLAM), [], 0.0, []
    for item in items:
        begin = time.process_time()
        new = front_end.add_image(item) if isinstance(item, Image) else front_end.add_imu(item)
        spent += time.process_time() - begin
        if new:
            outputs += new
            times.append(1e3 * spent / len(new))
            spent = 0.0
    return outputs, np.array(times)


def patches(outputs: list[FrontEndOutput]) -> Iterator[Track]:
    """Yield each patch's life; a new patch of the same track (flag TEMPLATE) begins another."""
    alive: dict[int, tuple[int, list[FloatArray], list[float]]] = {}
    for k, output in enumerate(outputs):
        tracks, seen = output.tracks, set(output.tracks.ids.tolist())
        for i in [i for i in alive if i not in seen]:
            birth, pixels, sigma = alive.pop(i)
            yield Track(birth, np.array(pixels), np.array(sigma))
        for i, pixel, sigma_px, flags in zip(tracks.ids.tolist(), tracks.pixels, tracks.sigma_px, tracks.flags, strict=True):
            if flags & TrackFlag.TEMPLATE and i in alive:
                birth, pixels, sigma = alive.pop(i)
                yield Track(birth, np.array(pixels), np.array(sigma))
            alive.setdefault(i, (k, [], []))
            alive[i][1].append(pixel)
            alive[i][2].append(float(sigma_px))
    for birth, pixels, sigma in alive.values():
        yield Track(birth, np.array(pixels), np.array(sigma))


@dataclass(frozen=True)
class Errors:
    """Of all patches at one age: true displacement (N, 2), error (N, 2), sigma (N,), depth edge (N,); share that ended before."""

    displacement: FloatArray
    error: FloatArray
    sigma: FloatArray
    edge: BoolArray
    ended: float

    def row(self, mask: BoolArray) -> str:
        """Return lag in %, scatter, 95th percentile and the RMS of error over sigma, as text."""
        moved, error = self.displacement[mask], self.error[mask]
        lag = float((moved * error).sum() / (moved * moved).sum())
        rest = error - lag * moved
        scatter, tail = np.sqrt((rest**2).mean()), np.percentile(np.abs(rest), 95)
        core = np.abs(error) < np.percentile(np.abs(error), 95)
        consistency = np.sqrt(((error / self.sigma[mask, None])[core] ** 2).mean())
        return f"{100 * lag:+6.2f} {scatter:6.3f} {tail:6.3f} {consistency:6.2f} {mask.sum():6d}"


def errors_at(tracks: list[Track], outputs: list[FrontEndOutput], truth: Truth, age: int) -> Errors:
    """Measure all patches whose surface point is in view ``age`` frames after birth."""
    moved, errors, sigmas, edges, alive, expected = [], [], [], [], 0, 0
    by_birth: dict[int, list[Track]] = {}
    for track in tracks:
        if track.birth + age < len(outputs):
            by_birth.setdefault(track.birth, []).append(track)
    for birth, group in by_birth.items():
        born_ns, now_ns = outputs[birth].tracks.stamp_ns, outputs[birth + age].tracks.stamp_ns
        first = np.stack([track.pixels[0] for track in group])
        true, seen = truth.pixels(now_ns, truth.points(born_ns, truth.calibration.camera.unproject(first)))
        reached = seen & np.array([len(track.pixels) > age for track in group])
        alive, expected = alive + int(reached.sum()), expected + int(seen.sum())
        if reached.any():
            kept = [track for track, ok in zip(group, reached, strict=True) if ok]
            errors.append(np.stack([track.pixels[age] for track in kept]) - true[reached])
            moved.append(true[reached] - first[reached])
            sigmas.append(np.array([track.sigma[age] for track in kept]))
            edges.append(truth.on_edge(born_ns, first[reached]))
    columns = (np.concatenate(column) for column in (moved, errors, sigmas, edges))
    return Errors(*columns, ended=1 - alive / max(expected, 1))  # type: ignore[arg-type]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("directory", type=Path, nargs="?", default=DATA)
    parser.add_argument("--frames", type=int, default=750)
    parser.add_argument("--only", choices=list(TRACKERS))
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    warm_up()
    calibration = load_calibration(arguments.directory / "calibration.yaml")
    truth = Truth.load(arguments.directory)
    items = list(long_frames(arguments.directory, calibration, arguments.frames))
    print("tracker          ms mean/p95   age ended % | lag %, scatter, p95 px, error/sigma, N: smooth | across depth edges")
    for name, config in TRACKERS.items():
        if arguments.only in (None, name):
            outputs, times = run(items, calibration, config)
            tracks = list(patches(outputs))
            for age in AGES:
                found = errors_at(tracks, outputs, truth, age)
                row = f"{times.mean():5.2f} /{np.percentile(times, 95):5.2f} {age:4d} {100 * found.ended:7.1f}"
                print(f"{name:16} {row} | {found.row(~found.edge)} | {found.row(found.edge)}")


if __name__ == "__main__":
    main()
