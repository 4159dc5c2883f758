"""Figures of the map alone: accuracy with true poses, and time against the size of the map.

Run from the root of the workspace: ``python test/perf/bench_map.py [--data ../shared/data/keyboard_short] [--noise 0.06] [--sizes 0.1 1 5]``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from vli_bringup.evaluation_data import read_cloud, read_surface
from vli_bringup.map_metrics import completeness_figures, nearest_map_points, surface_distances, surface_figures
from vli_bringup.tum import Trajectory, read_tum
from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration, load_calibration
from vli_common.geometry import pose, so3_exp
from vli_common.types import EncodedImage, Exposure, FrameKind, Mode, WindowPoses
from vli_driver.bag import BagReader, BagTopics
from vli_driver.config import DemuxConfig, StripeConfig
from vli_driver.decode import decode
from vli_driver.demux import Demultiplexer
from vli_driver.scanner import StripeScanner
from vli_mapping.config import MappingConfig
from vli_mapping.mapper import Mapper
from vli_mapping.point_map import PointMap, Stripe
from vli_mapping.warm_up import warm_up

KEYFRAME_EVERY = 8
"""Long frames."""
WINDOW = 8
"""Keyframes."""
REST_S = 1.5
_SHEET, _POINTS = 1000, 600
"""Points of a row of the synthetic sheet, and of a stripe that falls on a part of one."""


def true_windows(trajectory: Trajectory, noise_m: float, seed: int = 0) -> Iterator[WindowPoses]:
    """Yield what a back end would say that knows the truth, but for a slow error of ``noise_m`` RMS in position."""
    rng = np.random.default_rng(seed)
    stamps, T = trajectory.stamps_ns, trajectory.poses.copy()
    knots = rng.normal(size=(len(T) // 60 + 2, 3)) * noise_m / np.sqrt(3)
    for axis in range(3):
        T[:, axis, 3] += np.interp(np.arange(len(T)) / 60, np.arange(len(knots)), knots[:, axis]) * np.sqrt(1.5)
    kinds = np.where(np.arange(len(T)) % 2 == 0, FrameKind.LONG.value, FrameKind.SHORT.value).astype(np.uint8)
    kinds[:: 2 * KEYFRAME_EVERY] = FrameKind.KEYFRAME.value
    keyframes = np.flatnonzero(kinds == FrameKind.KEYFRAME.value)
    redundant = (stamps < stamps[0] + int(REST_S * 1e9)) & (np.arange(len(T)) > 2 * KEYFRAME_EVERY)
    left = 0
    for number, newest in enumerate(keyframes):
        oldest = keyframes[max(number - WINDOW + 1, 0)]
        which = slice(left, newest + 1)
        final = np.arange(left, newest + 1) < oldest
        if newest == keyframes[-1]:
            final[:] = True
        yield WindowPoses(int(stamps[newest]), stamps[which], kinds[which], final, redundant[which], T[which])
        left = oldest


def scan_with_truth(data: Path, calibration: Calibration, noise_m: float, cached: dict[str, list[object]]) -> Mapper:
    """Return the mapper after the whole recording; print times."""
    mapper = Mapper(calibration, MappingConfig(), Mode.VLI_SLAM)
    if not cached:
        cached.update(_read(data, calibration))
    images, scans = iter(cached["images"]), iter(cached["scans"])
    image, scan = next(images), next(scans)
    spent = []
    residuals = []
    for window in true_windows(read_tum(data / "truth.tum"), noise_m):
        while image is not None and image.stamp_ns <= window.stamp_ns:
            mapper.add_image(image)
            image = next(images, None)
        while scan is not None and scan.stamp_ns <= window.stamp_ns:
            mapper.add_scan(scan)
            scan = next(scans, None)
        start = time.perf_counter()
        output = mapper.add_window(window)
        spent.append(time.perf_counter() - start)
        if output.constraints is not None:
            residuals.append(_residuals(output.constraints, window))
    times = 1e3 * np.array(spent)
    print(f"keyframe: {times.mean():.2f} ms mean, {np.median(times):.2f} median, {np.percentile(times, 95):.2f} p95, {times.max():.1f} max; "
          f"a scan: {times.sum() / max(mapper.counters['scans_entered'], 1):.2f} ms")
    if residuals:
        r = np.concatenate(residuals)
        print(f"constraints: {len(residuals)} windows, {len(r) / len(residuals):.0f} each, "
              f"residual {1e3 * np.sqrt((r**2).mean()):.3f} mm RMS, {1e3 * np.median(np.abs(r)):.3f} median, mean {1e3 * r.mean():.4f}")
    print(dict(sorted(mapper.counters.values.items())))
    return mapper


def _residuals(constraints, window) -> FloatArray:  # type: ignore[no-untyped-def]
    T = window.T_map_camera[np.searchsorted(window.stamps, constraints.scan_stamps)]
    points = np.einsum("nij,nj->ni", T[:, :3, :3], constraints.points_camera) + T[:, :3, 3]
    return np.einsum("ni,ni->n", constraints.points_map - points, constraints.normals_map)


def _read(data: Path, calibration: Calibration) -> dict[str, list[object]]:
    demultiplexer, scanner = Demultiplexer(DemuxConfig()), StripeScanner(calibration, StripeConfig())
    images, scans = [], []
    for item in BagReader(data / "bag", BagTopics()):
        if isinstance(item, EncodedImage):
            _sort(demultiplexer.push(decode(item)), scanner, images, scans)
    _sort(demultiplexer.flush(), scanner, images, scans)
    return {"images": images, "scans": scans}


def _sort(ready, scanner, images, scans) -> None:  # type: ignore[no-untyped-def]
    for exposure, image in ready:
        if exposure is Exposure.LONG:
            images.append(image)
        else:
            scans.append(scanner.scan(image))


def print_accuracy(mapper: Mapper, data: Path) -> None:
    """Print the figures of docs/evaluation for a map in the frame of the truth."""
    cloud = mapper.map.cloud()
    surface = surface_figures(surface_distances(cloud.points.astype(np.float64), read_surface(data / "surface.ply")))
    seen = read_cloud(data / "seen.ply")
    covered, nearest = nearest_map_points(seen.points, cloud.points)
    complete = completeness_figures(covered, (seen.colours[covered], cloud.colours[nearest[covered]]))
    print(f"points {len(cloud)}; point-to-plane {surface.map_point_to_plane_rmse_mm:.4f} mm RMSE ({surface.map_point_to_plane_median_mm:.4f} median), "
          f"point-to-point {surface.map_point_to_point_rmse_mm:.4f}; beyond 0.5 mm {surface.beyond_0_5mm_percent:.3f} %, 1 mm "
          f"{surface.beyond_1mm_percent:.3f} %; complete {complete.completeness_percent:.2f} %; "
          f"colour {255 * complete.colour_rmse:.2f}/255; with normal {100 * cloud.normals.any(axis=1).mean():.1f} %")


def print_scaling(sizes: list[float]) -> None:
    """Print the time of a stripe's entry at several sizes of a synthetic map: a wavy sheet with points 0.25 mm apart."""
    for millions in sizes:
        rows = int(millions * 1e6) // _SHEET
        point_map = PointMap()
        rng = np.random.default_rng(1)
        for row in range(rows):
            point_map.insert(_stripe(row, _SHEET, 0, row, rng))
        spent = []
        for number, row in enumerate(rng.integers(0, rows, 300)):
            stripe = _stripe(row, _POINTS, int(rng.integers(0, _SHEET - _POINTS)), rows + number, rng)
            start = time.perf_counter()
            target = point_map.insert(stripe)
            point_map.refine_normals(np.unique(target), stripe.viewpoint)
            spent.append(time.perf_counter() - start)
        print(
            f"{len(point_map) / 1e6:.2f} million points: {1e3 * np.median(spent):.3f} ms a stripe of {len(stripe)} (median), "
            f"{1e3 * np.percentile(spent, 95):.3f} p95, {_memory_mb():.0f} MB resident"
        )


def _stripe(row: int, count: int, start: int, number: int, rng: np.random.Generator) -> Stripe:
    x = (start + np.arange(count)) * 2.5e-4
    y = np.full(count, row * 2.5e-4)
    points = np.stack([x, y, 2e-3 * np.sin(40 * x) + 2e-3 * np.cos(30 * y)], axis=1) + rng.normal(size=(count, 3)) * 2e-5
    return Stripe(
        int(number * 33e6), number, points.mean(axis=0) + [0, 0, 0.03], points, np.zeros((count, 3), np.float32),
        np.zeros(count, np.float32), np.full((count, 3), 100, np.float32), np.full(count, 5e-5), np.ones(count, np.bool_),
    )


def _memory_mb() -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    return float("nan")


def main() -> None:
    """Print all figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path(__file__).resolve().parents[3] / "shared/data/keyboard_short")
    parser.add_argument("--noise", type=float, nargs="*", default=[0.0, 0.06], help="RMS of the slow error of the poses, mm")
    parser.add_argument("--sizes", type=float, nargs="*", default=[0.1, 1.0, 5.0], help="millions of points")
    args = parser.parse_args()
    warm_up()
    print_scaling(args.sizes)
    calibration, cached = load_calibration(args.data / "calibration.yaml"), {}
    for noise in args.noise:
        print(f"poses with {noise} mm of error")
        print_accuracy(scan_with_truth(args.data, calibration, 1e-3 * noise, cached), args.data)


if __name__ == "__main__":
    main()
