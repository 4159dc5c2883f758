"""How well passes over the same spot agree: points of one pass against planes through those of the pass before it.

    python test/perf/bench_passes.py [RECORDING [RUN ...]]

RECORDING has ``bag``, ``calibration.yaml``, ``truth.tum`` and ``passes.json``, as ``vli simulate`` writes them; a RUN is what
``vli run`` made of it. Scans are as detected, with the poses of each run, and with the true ones: what is then left is the
stripe's own noise.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from bench_map import DATA, read_frames
from scipy.interpolate import CubicSpline
from scipy.spatial import KDTree

from vli_bringup.evaluation_data import read_passes
from vli_bringup.tum import Trajectory, read_tum
from vli_common.arrays import FloatArray, IntArray
from vli_common.calibration import load_calibration
from vli_common.geometry import pose, so3_exp, so3_log, transform
from vli_common.types import NANOSECONDS, LaserScan

RADIUS_M, MIN_POINTS, MOST_POINTS = 5e-4, 8, 64
EVERY = 5
"""Points of the later pass that are compared: one in so many."""
_GAP_NS = NANOSECONDS // 10


def scan_poses(trajectory: Trajectory, stamps_ns: Sequence[int]) -> dict[int, FloatArray]:
    """Return T_fixed_camera (4, 4) by stamp, from a cubic spline through the poses around it; none across a gap in them."""
    known = trajectory.stamps_ns
    reference = trajectory.poses[len(known) // 2, :3, :3]
    seconds = (known - known[0]) / NANOSECONDS
    vectors = so3_log(reference.T @ trajectory.poses[:, :3, :3])
    spline = CubicSpline(seconds, np.concatenate([trajectory.positions, vectors], axis=1))
    wanted = np.asarray(stamps_ns)
    after = np.clip(np.searchsorted(known, wanted), 1, len(known) - 1)
    inside = (wanted >= known[0]) & (wanted <= known[-1]) & (known[after] - known[after - 1] < _GAP_NS)
    values = spline((wanted[inside] - known[0]) / NANOSECONDS)
    T = pose(reference @ so3_exp(values[:, 3:]), values[:, :3])
    return dict(zip(wanted[inside].tolist(), T, strict=True))


def plane_distances(points: FloatArray, surface: FloatArray) -> FloatArray:
    """Return the distances (K,) of those points (N, 3) that have a plane of enough points of ``surface`` (M, 3) around them."""
    distance, index = KDTree(surface).query(points, k=MOST_POINTS, distance_upper_bound=RADIUS_M)
    near = np.isfinite(distance)
    enough = near.sum(axis=1) >= MIN_POINTS
    near, index, points = near[enough], np.where(near, index, 0)[enough], points[enough]
    weight = near[:, :, None] / near.sum(axis=1)[:, None, None]
    centroid = (weight * surface[index]).sum(axis=1)
    spread = np.where(near[:, :, None], surface[index] - centroid[:, None], 0.0)
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1][:, :, 0]
    result: FloatArray = np.abs(np.einsum("ni,ni->n", points - centroid, normal))
    return result


def disagreement(scans: Sequence[LaserScan], poses: dict[int, FloatArray], passes: IntArray) -> FloatArray:
    """Return the distances (K,), metres, of the points of each pass (P, 2 stamps) to the planes of the pass before it."""
    clouds = []
    for start, end in passes.tolist():
        inside = [scan for scan in scans if start <= scan.stamp_ns <= end and scan.stamp_ns in poses]
        clouds.append(np.concatenate([np.empty((0, 3)), *(transform(poses[scan.stamp_ns], scan.points) for scan in inside)]))
    pairs = zip(clouds[1:], clouds[:-1], strict=True)
    return np.concatenate([plane_distances(later[::EVERY], earlier) for later, earlier in pairs if len(later) and len(earlier)])


def main() -> None:
    """Print one line for the true poses, and one a run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, nargs="?", default=DATA)
    parser.add_argument("runs", type=Path, nargs="*")
    args = parser.parse_args()
    calibration = load_calibration(args.recording / "calibration.yaml")
    scans = [frame for frame in read_frames(args.recording, calibration) if isinstance(frame, LaserScan) and len(frame)]
    passes = read_passes(args.recording / "passes.json")
    true = read_tum(args.recording / "truth.tum")
    stamps = [scan.stamp_ns for scan in scans]
    best = np.median(disagreement(scans, scan_poses(true, stamps), passes))
    print(f"true poses: {1e3 * best:.4f} mm median")
    for run in args.runs:
        found = disagreement(scans, scan_poses(read_tum(run / "trajectory_final.tum"), stamps), passes)
        median = np.median(found)
        print(f"{run.name}: {1e3 * median:.4f} mm, {median / best:.3f} × that of true poses ({len(found)} points)")


if __name__ == "__main__":
    main()
