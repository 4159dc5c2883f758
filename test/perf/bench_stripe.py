"""Stripe cloud of a recording against its true surface, poses true: what sensor model, detector and triangulation leave.

    python test/perf/bench_stripe.py [RECORDING]

RECORDING (default ``../shared/data/keyboard_short``) holds ``bag/``, ``calibration.yaml``, ``truth.tum``, ``surface.ply``,
``seen.ply``.
Exit code 1 where a bar is missed.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration, load_calibration
from vli_common.geometry import pose, transform
from vli_common.types import NANOSECONDS, EncodedImage, Exposure, LaserScan
from vli_driver.bag import BagReader
from vli_driver.decode import decode
from vli_driver.demux import Demultiplexer
from vli_driver.scanner import StripeScanner
from vli_driver.warm_up import warm_up

SPACING_M = 1e-4
NEAR_M = 1e-3
SEEN_M = 5e-4
BARS = {"point-to-plane RMSE, mm": 0.075, "ms per short frame after decoding": 1.5}


class Truth:
    """True camera poses, interpolated between the lines of a TUM file."""

    def __init__(self, path: Path) -> None:
        rows = np.loadtxt(path, comments="#")
        # Floats of 1e9 s resolve 0.1 µs at best: enough for 1.4 cm/s.
        self._times, self._positions = rows[:, 0], rows[:, 1:4]
        self._rotations = Slerp(rows[:, 0], Rotation.from_quat(rows[:, 4:8]))

    def at(self, stamp_ns: int) -> FloatArray | None:
        """Return T_world_camera (4, 4), None outside the recording."""
        t = stamp_ns / NANOSECONDS
        if not self._times[0] <= t <= self._times[-1]:
            return None
        position = [np.interp(t, self._times, column) for column in self._positions.T]
        return pose(self._rotations(t).as_matrix(), np.array(position))


def scan_all(bag: Path, calibration: Calibration) -> tuple[list[LaserScan], dict[str, float]]:
    """Return every scan of a bag, and mean times in ms."""
    demultiplexer, scanner = Demultiplexer(), StripeScanner(calibration)
    scans: list[LaserScan] = []
    spent = {"decode": 0.0, "demux": 0.0, "scan": 0.0}
    images = 0
    for item in BagReader(bag):
        if not isinstance(item, EncodedImage):
            continue
        images += 1
        begin = time.perf_counter()
        image = decode(item)
        decoded = time.perf_counter()
        ready = demultiplexer.push(image)
        sorted_at = time.perf_counter()
        scans += [scanner.scan(frame) for exposure, frame in ready if exposure is Exposure.SHORT]
        done = time.perf_counter()
        for name, span in (("decode", decoded - begin), ("demux", sorted_at - decoded), ("scan", done - sorted_at)):
            spent[name] += 1e3 * span
    return scans, {
        "ms decoding per image": spent["decode"] / images,
        "ms sorting per image": spent["demux"] / images,
        "ms per short frame after decoding": (spent["scan"] / len(scans)) + spent["demux"] / images,
    }


def sample_surface(path: Path) -> tuple[FloatArray, FloatArray]:
    """Return points (N, 3) at 0.1 mm from each other on average, and their unit normals (N, 3)."""
    mesh = trimesh.load(path)
    rng = np.random.default_rng(0)
    count = int(mesh.area / SPACING_M**2)
    faces = rng.choice(len(mesh.faces), count, p=mesh.area_faces / mesh.area)
    corner = rng.random((count, 2))
    corner[corner.sum(axis=1) > 1] = 1 - corner[corner.sum(axis=1) > 1]
    a, b, c = (mesh.triangles[faces][:, k] for k in range(3))
    return a + corner[:, :1] * (b - a) + corner[:, 1:] * (c - a), mesh.face_normals[faces]


def accuracy(points: FloatArray, sigma: FloatArray, surface: Path) -> dict[str, float]:
    """Return the figures of design.md, and how the true errors compare with the sigmas."""
    samples, normals = sample_surface(surface)
    distance, nearest = cKDTree(samples, balanced_tree=False, compact_nodes=False).query(points, distance_upper_bound=3 * NEAR_M)
    near = distance < NEAR_M
    to_plane = np.abs(np.einsum("ij,ij->i", points[near] - samples[nearest[near]], normals[nearest[near]]))
    return {
        "point-to-plane RMSE, mm": 1e3 * float(np.sqrt(np.mean(to_plane**2))),
        "point-to-plane median, mm": 1e3 * float(np.median(to_plane)),
        "point-to-point RMSE, mm": 1e3 * float(np.sqrt(np.mean(distance[near] ** 2))),
        "share beyond 0.5 mm": float(np.mean(distance > 0.5e-3)),
        "share beyond 1 mm": float(np.mean(distance > 1e-3)),
        "median sigma, mm": 1e3 * float(np.median(sigma)),
        "median error over sigma (1: consistent)": float(np.median(to_plane / sigma[near])) / 0.6745,
    }


def main() -> int:
    """Print the figures; return 1 where a bar is missed."""
    default = Path(__file__).resolve().parents[3] / "shared/data/keyboard_short"
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, nargs="?", default=default)
    parser.add_argument("--every", type=int, default=3, help="measure the accuracy of every so many points")
    arguments = parser.parse_args()
    recording: Path = arguments.recording
    warm_up()
    scans, figures = scan_all(recording / "bag", load_calibration(recording / "calibration.yaml"))
    truth = Truth(recording / "truth.tum")
    posed = [(T, scan) for scan in scans if (T := truth.at(scan.stamp_ns)) is not None]
    points = np.concatenate([transform(T, scan.points) for T, scan in posed])
    sigma = np.concatenate([scan.sigma for _, scan in posed])
    figures["points per short frame"] = len(points) / len(posed)
    chosen = slice(None, None, arguments.every)
    figures |= accuracy(points[chosen], sigma[chosen], recording / "surface.ply")
    seen = np.asarray(trimesh.load(recording / "seen.ply").vertices)
    gap, _ = cKDTree(points).query(seen, distance_upper_bound=2 * SEEN_M)
    figures["completeness"] = float(np.mean(gap < SEEN_M))
    for name, value in figures.items():
        bar = f"   (bar {BARS[name]:g})" if name in BARS else ""
        print(f"{name:42s} {value:8.4f}{bar}")
    return int(any(figures[name] > bar for name, bar in BARS.items()))


if __name__ == "__main__":
    sys.exit(main())
