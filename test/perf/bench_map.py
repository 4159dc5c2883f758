"""Figures of the map alone: accuracy with true poses; time, memory, locks of a save and colours against the size of the map.

Run from the root of the workspace::

    python test/perf/bench_map.py [--data ../shared/data/keyboard_short] [--noise 0 0.06] [--sizes 0.1 1 5]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vli_bringup.evaluation_data import read_cloud, read_surface
from vli_bringup.map_metrics import completeness_figures, nearest_map_points, surface_distances, surface_figures
from vli_bringup.tum import Trajectory, read_tum
from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration, load_calibration
from vli_common.geometry import transform
from vli_common.types import EncodedImage, Exposure, FrameKind, Image, LaserScan, MapConstraints, WindowPoses
from vli_driver.bag import BagReader, BagTopics
from vli_driver.config import DemuxConfig, StripeConfig
from vli_driver.decode import decode
from vli_driver.demux import Demultiplexer
from vli_driver.scanner import StripeScanner
from vli_mapping.albedo import albedo
from vli_mapping.config import MappingConfig
from vli_mapping.contradiction import contradict
from vli_mapping.light import Light
from vli_mapping.mapper import Mapper
from vli_mapping.point_map import PointMap, Stripe
from vli_mapping.snapshot import take
from vli_mapping.warm_up import warm_up

DATA = Path(__file__).resolve().parents[3] / "shared/data/keyboard_short"
KEYFRAME_EVERY = 8
"""Long frames."""
WINDOW = 8
"""Keyframes."""
REST_S = 1.5
"""At rest at the start of the recording: scans are redundant."""
SHEET, POINTS = 1000, 600
"""Points of a row of the synthetic sheet, and of a stripe that falls on a part of one."""
SPACING_M = 2.5e-4
LIGHT = Light(np.zeros(3), ambient=0.1, vignetting=(0.0, 0.2), reference_m=0.03)
_RESET_PEAK = "5"
"""Written to ``clear_refs``; see proc(5)."""


@dataclass
class Timed:
    """A mapper that has seen a whole recording, what each window took, and how its constraints fitted."""

    mapper: Mapper
    window_ms: list[float] = field(default_factory=list)
    residuals: list[FloatArray] = field(default_factory=list)

    def add(self, window: WindowPoses) -> None:
        """Give the mapper a window."""
        start = time.perf_counter()
        output = self.mapper.add_window(window)
        self.window_ms.append(1e3 * (time.perf_counter() - start))
        if output.constraints is not None:
            self.residuals.append(residuals(output.constraints, window))


def true_windows(trajectory: Trajectory, error_m: float, seed: int = 0) -> Iterator[WindowPoses]:
    """Yield what a back end would say that knows the truth, but for an error of ``error_m`` RMS that changes once a second."""
    stamps, T = trajectory.stamps_ns, trajectory.poses.copy()
    knots = np.random.default_rng(seed).normal(size=(len(T) // 60 + 2, 3))
    drift = np.stack([np.interp(np.arange(len(T)) / 60, np.arange(len(knots)), knots[:, axis]) for axis in range(3)], axis=1)
    T[:, :3, 3] += error_m * drift / np.sqrt((drift**2).sum(axis=1).mean())
    kinds = np.where(np.arange(len(T)) % 2 == 0, FrameKind.LONG.value, FrameKind.SHORT.value).astype(np.uint8)
    kinds[:: 2 * KEYFRAME_EVERY] = FrameKind.KEYFRAME.value
    redundant = (stamps < stamps[0] + int(REST_S * 1e9)) & (np.arange(len(T)) > 2 * KEYFRAME_EVERY)
    keyframes = np.flatnonzero(kinds == FrameKind.KEYFRAME.value)
    left = 0
    for number, newest in enumerate(keyframes):
        oldest = keyframes[max(number - WINDOW + 1, 0)]
        frames = np.arange(left, newest + 1)
        final = (frames < oldest) | (newest == keyframes[-1])
        yield WindowPoses(int(stamps[newest]), stamps[frames], kinds[frames], final, redundant[frames], T[frames])
        left = oldest


def residuals(constraints: MapConstraints, window: WindowPoses) -> FloatArray:
    """Return the point-to-plane distances (N,) of eq. (4), metres, at the poses of the window."""
    T_map_camera = window.T_map_camera[np.searchsorted(window.stamps, constraints.scan_stamps)]
    offset = constraints.points_map - transform(T_map_camera, constraints.points_camera)
    result: FloatArray = np.einsum("ni,ni->n", offset, constraints.normals_map)
    return result


def read_frames(data: Path, calibration: Calibration) -> Iterator[Image | LaserScan]:
    """Yield long images and scans of a recording, in order."""
    demultiplexer, scanner = Demultiplexer(DemuxConfig()), StripeScanner(calibration, StripeConfig())

    def sort(ready: Iterable[tuple[Exposure, Image]]) -> Iterator[Image | LaserScan]:
        for exposure, image in ready:
            yield image if exposure is Exposure.LONG else scanner.scan(image)

    for item in BagReader(data / "bag", BagTopics()):
        if isinstance(item, EncodedImage):
            yield from sort(demultiplexer.push(decode(item)))
    yield from sort(demultiplexer.flush())


def scan_with_truth(data: Path, calibration: Calibration, error_m: float) -> Mapper:
    """Return the mapper after the whole recording, with true poses but for ``error_m``."""
    return time_with_truth(data, calibration, error_m).mapper


def time_with_truth(
    data: Path,
    calibration: Calibration,
    error_m: float,
    config: MappingConfig | None = None,
    frames: Iterable[Image | LaserScan] | None = None,
) -> Timed:
    """Map a recording, or other ``frames`` of it, with true poses but for ``error_m``; each window comes when its frames have."""
    timed = Timed(Mapper(calibration, config))
    windows = true_windows(read_tum(data / "truth.tum"), error_m)
    window = next(windows, None)
    for frame in read_frames(data, calibration) if frames is None else frames:
        while window is not None and window.stamp_ns < frame.stamp_ns:
            timed.add(window)
            window = next(windows, None)
        if isinstance(frame, Image):
            timed.mapper.add_image(frame)
        else:
            timed.mapper.add_scan(frame)
    for last in [window, *windows]:
        if last is not None:
            timed.add(last)
    return timed


def print_times(timed: Timed) -> None:
    """Print the time of a keyframe and of a scan, the residuals of the constraints, and all counters."""
    times, entered = np.array(timed.window_ms), timed.mapper.counters["scans_entered"]
    print(
        f"a keyframe: {times.mean():.2f} ms mean, {np.median(times):.2f} median, {np.percentile(times, 95):.2f} p95; "
        f"a scan: {times.sum() / max(entered, 1):.2f} ms; a long frame: {times.mean() / KEYFRAME_EVERY:.2f} ms"
    )
    if timed.residuals:
        r = 1e3 * np.concatenate(timed.residuals)
        print(
            f"constraints: {len(timed.residuals)} windows, {len(r) / len(timed.residuals):.0f} each, residual "
            f"{np.sqrt((r**2).mean()):.3f} mm RMS, {np.median(np.abs(r)):.3f} median, {r.mean():.4f} mean"
        )
    print(dict(sorted(timed.mapper.counters.values.items())))


def print_accuracy(mapper: Mapper, data: Path) -> None:
    """Print the figures of docs/evaluation for a map in the frame of the truth."""
    cloud = mapper.map.cloud(light=mapper.light(), as_seen=True)
    surface = surface_figures(surface_distances(cloud.points.astype(np.float64), read_surface(data / "surface.ply")))
    seen = read_cloud(data / "seen.ply")
    covered, nearest = nearest_map_points(seen.points.astype(np.float64), cloud.points.astype(np.float64))
    complete = completeness_figures(covered, (seen.colours[covered], cloud.colours[nearest[covered]]))
    with_normal = 0.0 if cloud.normals is None else 100 * cloud.normals.any(axis=1).mean()
    print(
        f"{len(cloud)} points; point-to-plane {surface.map_point_to_plane_rmse_mm:.4f} mm RMSE "
        f"({surface.map_point_to_plane_median_mm:.4f} median), point-to-point {surface.map_point_to_point_rmse_mm:.4f}; "
        f"beyond 0.5 mm {surface.beyond_0_5mm_percent:.3f} %, 1 mm {surface.beyond_1mm_percent:.3f} %; "
        f"complete {complete.completeness_percent:.2f} %; colour {255 * (complete.colour_rmse or 0):.2f} of 255; "
        f"with normal {with_normal:.1f} %"
    )


def print_scaling(sizes: list[float]) -> None:
    """Print the time of a stripe's entry at several sizes of a synthetic map: a wavy sheet with points 0.25 mm apart."""
    for millions in sizes:
        rows = int(millions * 1e6) // SHEET
        point_map = PointMap()
        rng = np.random.default_rng(1)
        for row in range(rows):
            point_map.insert(sheet_stripe(row, SHEET, 0, row, rng))
        spent = []
        for number, row in enumerate(rng.integers(0, rows, 300).tolist()):
            stripe = sheet_stripe(row, POINTS, int(rng.integers(0, SHEET - POINTS)), rows + number, rng)
            start = time.perf_counter()
            trusted, *_ = contradict(point_map, stripe)
            target = point_map.insert(trusted)
            point_map.refine_normals(np.unique(target[target >= 0]), stripe.viewpoint)
            spent.append(1e3 * (time.perf_counter() - start))
        resident = memory_mb("VmRSS")
        locks = save_locks(point_map)
        print(
            f"{len(point_map) / 1e6:.2f} million points: {np.median(spent):.3f} ms a stripe of {POINTS} (median), "
            f"{np.percentile(spent, 95):.3f} p95, {resident:.0f} MB resident; a save locks the map {len(locks)} times, "
            f"{np.median(locks):.2f} ms (median), {max(locks):.2f} at most"
        )
        print_cost("colours of a file, each by its neighbourhood", len(point_map), partial(albedo, point_map, LIGHT))


def print_cost(what: str, points: int, work: Callable[[], Any]) -> None:
    """Print time and memory of some work on a map, per point."""
    Path("/proc/self/clear_refs").write_text(_RESET_PEAK)
    before, start = memory_mb("VmRSS"), time.perf_counter()
    work()
    spent, grown = time.perf_counter() - start, memory_mb("VmHWM") - before
    print(f"  {what}: {1e6 * spent / points:.1f} µs a point, {1e3 * grown / points:.2f} kB a point beside the map at most")


def save_locks(point_map: PointMap) -> list[float]:
    """Return how long, in milliseconds, each step of a copy of the map keeps others out."""
    spent = []

    def exclusively(step: Callable[[], Any]) -> Any:
        start = time.perf_counter()
        result = step()
        spent.append(1e3 * (time.perf_counter() - start))
        return result

    take(point_map, None, exclusively)
    return spent


def sheet_stripe(row: int, count: int, start: int, number: int, rng: np.random.Generator) -> Stripe:
    """Return ``count`` noisy points of a row of the sheet."""
    x, y = (start + np.arange(count)) * SPACING_M, np.full(count, row * SPACING_M)
    points = np.stack([x, y, 2e-3 * np.sin(40 * x) + 2e-3 * np.cos(30 * y)], axis=1) + rng.normal(size=(count, 3)) * 2e-5
    return Stripe(
        stamp_ns=number * 33_333_333,
        number=number,
        T_map_camera=looking_down(points.mean(axis=0) + np.array([0, 0, 0.03])),
        points=points,
        normals=np.zeros((count, 3), np.float32),
        planarity=np.zeros(count, np.float32),
        colours=np.full((count, 3), 100, np.float32),
        sigma=np.full(count, 5e-5),
        solid=np.ones(count, np.bool_),
    )


def looking_down(centre: FloatArray) -> FloatArray:
    """Return T_map_camera (4, 4) of a camera at ``centre`` (3,) that looks along −z of map."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = centre
    return T


def memory_mb(which: str) -> float:
    """Return the memory of this process: ``VmRSS``, or ``VmHWM``, the most since the peak was reset."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(which):
            return int(line.split()[1]) / 1024
    return float("nan")


def main() -> None:
    """Print all figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--noise", type=float, nargs="*", default=[0.0, 0.06], help="RMS of the slow error of the poses, mm")
    parser.add_argument("--sizes", type=float, nargs="*", default=[0.1, 1.0, 5.0], help="millions of points")
    args = parser.parse_args()
    warm_up()
    print_scaling(args.sizes)
    calibration = load_calibration(args.data / "calibration.yaml")
    for noise in args.noise:
        print(f"poses with {noise} mm of error")
        timed = time_with_truth(args.data, calibration, 1e-3 * noise)
        print_times(timed)
        print_accuracy(timed.mapper, args.data)
        photographs = len(timed.mapper.photographs())
        print_cost(f"what {photographs} photographs say of colours", len(timed.mapper.map), timed.mapper.develop)


if __name__ == "__main__":
    main()
