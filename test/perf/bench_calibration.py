"""What a calibration is worth: real sets against their references, simulated ones against their truth, and the time it takes.

    python test/perf/bench_calibration.py [--rows unified handheld …] [--seeds N] [--full]

Every figure comes from the commands as a user types them, each in a process of its own, and from the report's ``summary.json``.
By default simulated rows take a few seeds; ``--full`` is the whole table (20 and 10 seeds, two hours of IMU). Real sets are read
from ``../shared/data/blaser_calibration``; where that is absent, their rows say so.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from vli_calibration.tables import text_table
from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, so3_log

DATA = Path(__file__).resolve().parents[3] / "shared/data/blaser_calibration"
UNIFIED, HANDHELD, LASER_OFF = DATA / "640_unified", DATA / "handheld_1280x720", DATA / "640_v1_laser_off"
SMALL_BOARD, LARGE_BOARD = "chessboard:9x6:0.005", "chessboard:9x6:0.030"


@dataclass(frozen=True)
class Line:
    """One figure of the table; ``holds`` is None where nothing was measured."""

    subject: str
    figure: str
    measured: str
    bar: str
    holds: bool | None

    def cells(self) -> list[str]:
        """Return the row."""
        return [self.subject, self.figure, self.measured, self.bar, {True: "yes", False: "NO", None: "–"}[self.holds]]


class CommandFailedError(Exception):
    """A command ended with another code than expected; the text is what it said."""


@dataclass(frozen=True)
class Bench:
    """A directory for what the commands write, and how much is asked for.

    Args:
        directory: temporary.
        plane_seeds, imu_camera_seeds: simulated sets.
        rest_hours: of simulated IMU.
    """

    directory: Path
    plane_seeds: int
    imu_camera_seeds: int
    rest_hours: float

    def vli(self, *words: object, expected: int = 0) -> tuple[str, float, float]:
        """Run a command; return what it said on stderr, and the wall and processor seconds it took."""
        started, cpu = time.perf_counter(), _children_s()
        command = [sys.executable, "-m", "vli_bringup.cli", *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != expected:
            raise CommandFailedError(
                done.stderr.strip().splitlines()[-1] if done.stderr.strip() else f"exit code {done.returncode}"
            )
        return done.stderr.strip(), time.perf_counter() - started, _children_s() - cpu

    def calibrate(self, what: str, source: Path, out: str, *options: object) -> dict[str, Any]:
        """Run ``vli calibrate WHAT`` with a report; return its summary, with ``wall_s`` and ``cpu_s``."""
        report = self.directory / f"{out}_{what}"
        _, wall_s, cpu_s = self.vli("calibrate", what, source, *options, "--report", report)
        summary: dict[str, Any] = json.loads((report / "summary.json").read_text())
        return summary | {"wall_s": wall_s, "cpu_s": cpu_s}

    def file(self, out: str) -> Path:
        """Return the calibration file of that name."""
        return self.directory / f"{out}.yaml"

    def simulate(self, name: str, seed: int, *parts_and_options: object) -> Path:
        """Make calibration data with truth; return its directory."""
        directory = self.directory / name
        self.vli("simulate", "board", "--out", directory, "--seed", seed, "--parts", *parts_and_options)
        return directory

    def camera(self, source: Path, target: str, out: str) -> dict[str, Any]:
        """Calibrate a camera."""
        return self.calibrate("camera", source, out, "--target", target, "--out", self.file(out))

    def laser(self, source: Path, target: str, out: str, *options: object) -> dict[str, Any]:
        """Calibrate the laser plane of the camera of that name."""
        file = self.file(out)
        return self.calibrate("laser", source, out, "--target", target, "--calib", file, "--out", file, *options)


def unified(bench: Bench) -> Iterator[Line]:
    """Yield the figures of the small sensor on its arm."""
    subject = UNIFIED.name
    camera = bench.camera(UNIFIED, SMALL_BOARD, subject)
    yield _at_least(subject, "boards", camera["images_used"], 14, f" of {camera['images_total']}")
    yield _at_least(subject, "corners kept", camera["corners_used"], 690, f" of {camera['corners_total']}")
    yield _at_most(subject, "reprojection RMS, px", camera["reprojection_rms_px"], 0.25)
    laser = bench.laser(UNIFIED, SMALL_BOARD, subject, "--poses", UNIFIED / "data.txt")
    yield _at_most(subject, "laser plane RMS, joint, mm", laser["plane_rms_mm"], 0.040)
    yield _at_least(subject, "stripe points kept, %", 100 * laser["stripe_points_used"] / laser["stripe_points_total"], 90)
    reference = json.loads((DATA / "reference_calibration.json").read_text())[subject]["plane_jointBA"]
    degrees, millimetres = plane_difference(np.array(laser["plane"]), np.array([*reference["n"], reference["d_m"]]))
    yield _at_most(subject, "plane to reference, °", degrees, 0.15)
    yield _at_most(subject, "plane to reference, mm", millimetres, 0.1)
    yield _at_most(subject, "flat table through the arm, mm RMS", laser["table_rms_mm"], 0.42)
    yield _at_least(subject, "images of the table", laser["table_images"], 24)


def handheld(bench: Bench) -> Iterator[Line]:
    """Yield the figures of the wide sensor in the hand, and the time that both commands take."""
    subject = HANDHELD.name
    camera = bench.camera(HANDHELD, LARGE_BOARD, subject)
    yield _at_least(subject, "boards", camera["images_used"], 36, f" of {camera['images_total']}")
    yield _at_most(subject, f"reprojection RMS, px ({camera['model']})", camera["reprojection_rms_px"], 0.45)
    laser = bench.laser(HANDHELD, LARGE_BOARD, subject)
    yield _at_most(subject, "laser plane RMS, joint, mm", laser["plane_rms_mm"], 0.17)
    named = [item["name"] for item in laser["rejected"]]
    yield Line(subject, "the bad image named", ", ".join(sorted(set(named))), "im16.png", "im16.png" in named)
    cpu_s = camera["cpu_s"] + laser["cpu_s"]
    yield _at_most(subject, f"time, camera and laser, s ({cpu_s:.0f} of the processor)", camera["wall_s"] + laser["wall_s"], 60)


def laser_off(bench: Bench) -> Iterator[Line]:
    """Yield what is made of images without a stripe, on the camera that took them."""
    subject = LASER_OFF.name
    bench.camera(LASER_OFF, SMALL_BOARD, subject)
    said, *_ = bench.vli(
        "calibrate", "laser", LASER_OFF, "--target", SMALL_BOARD, "--calib", bench.file(subject), "--out", bench.file("none"),
        expected=2,
    )  # fmt: skip
    yield Line(subject, "no stripe found", said, "0 in 9 of 9, exit code 2", "no laser stripe found in 9 of 9" in said)


def plane(bench: Bench) -> Iterator[Line]:
    """Yield how simulated planes compare with their truth, and with the intervals that are claimed for them."""
    subject = f"simulated boards, {bench.plane_seeds} seeds"
    inside, errors, half_widths = 0, [], []
    for seed in range(1, bench.plane_seeds + 1):
        name = f"board{seed}"
        directory = bench.simulate(name, seed, "camera", "laser")
        bench.camera(directory / "camera", SMALL_BOARD, name)
        summary = bench.laser(directory / "laser", SMALL_BOARD, name)
        truth = np.array(_truth(directory)["laser0"]["plane"])
        low, high = np.array([summary["intervals"][key] for key in ("nx", "ny", "nz", "d")]).T
        inside += bool(((low <= truth) & (truth <= high)).all())
        errors.append(plane_difference(np.array(summary["plane"]), truth))
        half_widths.append((math.degrees(0.5 * (high - low)[:3].max()), 0.5e3 * (high - low)[3]))
    degrees, millimetres = np.array(errors).T
    yield _at_least(subject, "truth inside the 95 % intervals", inside, math.ceil(0.85 * bench.plane_seeds))
    yield _at_most(subject, "largest half-width, °", max(width[0] for width in half_widths), 0.15)
    yield _at_most(subject, "largest half-width, mm", max(width[1] for width in half_widths), 0.10)
    yield Line(subject, "error of the plane, median / max, °", _median_and_max(degrees), "", None)
    yield Line(subject, "error of its distance, median / max, mm", _median_and_max(millimetres), "", None)


def imu_camera(bench: Bench) -> Iterator[Line]:
    """Yield the errors of rotation, translation and time offset from simulated bags, the camera calibrated first."""
    subject = f"simulated imu-camera, {bench.imu_camera_seeds} seeds"
    degrees, millimetres, milliseconds = [], [], []
    for seed in range(1, bench.imu_camera_seeds + 1):
        name = f"motion{seed}"
        directory = bench.simulate(name, seed, "camera", "bag")
        file = bench.file(name)
        # The IMU's noise as its data sheet has it, and no more of T_cam_imu than the drawing.
        shutil.copy(directory / "nominal.yaml", file)
        bench.camera(directory / "camera", SMALL_BOARD, name)
        bench.calibrate("imu-camera", directory / "bag", name, "--target", SMALL_BOARD, "--calib", file, "--out", file)
        found, truth = yaml.safe_load(file.read_text())["cam0"], _truth(directory)["cam0"]
        error = inverse(np.array(truth["T_cam_imu"])) @ np.array(found["T_cam_imu"])
        degrees.append(math.degrees(float(np.linalg.norm(so3_log(error[:3, :3])))))
        millimetres.append(1e3 * float(np.linalg.norm(np.subtract(truth["T_cam_imu"], found["T_cam_imu"])[:3, 3])))
        milliseconds.append(1e3 * abs(truth["timeshift_cam_imu"] - found["timeshift_cam_imu"]))
    yield _at_most(subject, "rotation, largest error, °", max(degrees), 0.1)
    yield _at_most(subject, "translation, largest error, mm", max(millimetres), 0.5)
    yield _at_most(subject, "time offset, largest error, ms", max(milliseconds), 0.3)


def imu(bench: Bench) -> Iterator[Line]:
    """Yield the errors of the noise figures from a simulated IMU at rest."""
    subject = f"simulated IMU at rest, {bench.rest_hours:g} h"
    directory = bench.simulate("rest", 1, "rest", "--rest-hours", bench.rest_hours)
    bench.calibrate("imu", directory / "imu_rest", "rest", "--out", bench.file("rest"))
    found, truth = yaml.safe_load(bench.file("rest").read_text())["imu0"], _truth(directory)["imu0"]
    for kind, bar in (("noise_density", 5), ("random_walk", 20)):
        for sensor in ("gyroscope", "accelerometer"):
            key = f"{sensor}_{kind}"
            yield _at_most(subject, f"{key.replace('_', ' ')}, error, %", 100 * abs(found[key] / truth[key] - 1), bar)


def _truth(directory: Path) -> dict[str, Any]:
    document: dict[str, Any] = yaml.safe_load((directory / "calibration.yaml").read_text())
    return document


def _median_and_max(values: FloatArray) -> str:
    return f"{np.median(values):.3f} / {values.max():.3f}"


def _children_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def plane_difference(plane: FloatArray, reference: FloatArray) -> tuple[float, float]:
    """Return the angle (degrees) between two planes [n, d] and the difference of their d (mm)."""
    cosine = float(plane[:3] @ reference[:3])
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine)))), 1e3 * abs(float(plane[3] - reference[3]))


def _at_least(subject: str, figure: str, value: float, bar: float, note: str = "") -> Line:
    return Line(subject, figure, f"{value:.4g}{note}", f"≥ {bar:g}", value >= bar)


def _at_most(subject: str, figure: str, value: float | None, bar: float) -> Line:
    return Line(subject, figure, "none" if value is None else f"{value:.3g}", f"≤ {bar:g}", value is not None and value <= bar)


ROWS: dict[str, tuple[Callable[[Bench], Iterator[Line]], Path | None]] = {
    "unified": (unified, UNIFIED),
    "handheld": (handheld, HANDHELD),
    "laser-off": (laser_off, LASER_OFF),
    "plane": (plane, None),
    "imu-camera": (imu_camera, None),
    "imu": (imu, None),
}
"""Name → what yields the lines, and the directory it needs."""


def measure(bench: Bench, names: Sequence[str]) -> Iterator[Line]:
    """Yield the lines of the rows; one that cannot be had says why."""
    for name in names:
        row, needed = ROWS[name]
        if needed is not None and not needed.is_dir():
            yield Line(name, "skipped", f"needs '{needed}'", "", None)
            continue
        try:
            for line in row(bench):
                print(*line.cells(), sep=" | ", file=sys.stderr)
                yield line
        except (CommandFailedError, KeyError) as error:
            yield Line(name, "failed", str(error), "", False)


def main() -> int:
    """Print the table; return 1 where a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS), help="default: all")
    parser.add_argument("--full", action="store_true", help="20 and 10 seeds, two hours of IMU")
    parser.add_argument("--seeds", type=int, help="for both simulated rows")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        bench = Bench(
            Path(directory),
            plane_seeds=args.seeds or (20 if args.full else 2),
            imu_camera_seeds=args.seeds or (10 if args.full else 1),
            rest_hours=2.0 if args.full else 0.5,
        )
        lines = list(measure(bench, args.rows))
    print(text_table(["set", "figure", "measured", "bar", "held"], [line.cells() for line in lines]))
    return int(any(line.holds is False for line in lines))


if __name__ == "__main__":
    sys.exit(main())
