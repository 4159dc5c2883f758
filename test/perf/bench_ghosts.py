"""What ghosts do to the map: pieces of the stripe that stand elsewhere for some scans, as reflections make them, with true poses.

    python test/perf/bench_ghosts.py [RECORDING] [--rates 0 0.05]

Each line: how often a ghost begins (a scan), whether views may contradict points and take pieces, and the figures of
docs/evaluation.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from bench_map import DATA, read_frames, time_with_truth

from vli_bringup.evaluation_data import read_cloud, read_surface
from vli_bringup.map_metrics import nearest_map_points, surface_distances, surface_figures
from vli_common.calibration import Calibration, load_calibration
from vli_common.types import Image, LaserScan
from vli_driver.triangulation import Triangulator, stripe_runs_across_columns
from vli_mapping.config import MapConfig, MappingConfig
from vli_mapping.mapper import Mapper

SCANS, SHARE, SHIFT_PX, DRIFT_PX = (2, 12), (0.02, 0.15), (5.0, 60.0), 2.0
"""Of a ghost: scans it lasts, share of the stripe, how far it stands from it, and how far it moves a scan."""
ERROR_M = 5e-5
"""RMS of the slow error of the poses: without any, a map is better than it ever is."""

LIMITS = {
    "nothing contradicted": MapConfig(ray_radius=0.0),
    "points contradicted": MapConfig(piece_share=1.0),
    "pieces leave with them": MapConfig(),
}


@dataclass
class Ghost:
    """A piece of the stripe, from one share of its length to another, that stands ``shift_px`` away for some more scans."""

    scans: int
    first: float
    last: float
    shift_px: float
    drift_px: float


class Haunted:
    """Moves pieces of scans.

    Args:
        calibration: of camera and laser.
        rate: ghosts that begin, a scan.
        seed: of all that is random.
    """

    def __init__(self, calibration: Calibration, rate: float, seed: int = 0) -> None:
        if calibration.laser is None:
            raise SystemExit("the calibration has no laser")
        self._rate, self._rng = rate, np.random.default_rng(seed)
        across_columns = stripe_runs_across_columns(calibration.laser)
        self._axis = 1 if across_columns else 0
        self._size = np.array([calibration.camera.width, calibration.camera.height])
        self._triangulator = Triangulator(calibration, across_columns, 0.1)
        self._ghosts: list[Ghost] = []

    def __call__(self, scan: LaserScan) -> LaserScan:
        """Return the scan with the ghosts of its time; those that are out of sight take their piece with them."""
        self._begin()
        pixels, moved, count = scan.pixels.copy(), np.zeros(len(scan), np.bool_), len(scan)
        for ghost in self._ghosts:
            piece = slice(int(ghost.first * count), int(ghost.last * count))
            pixels[piece, self._axis] += ghost.shift_px
            moved[piece] = True
            ghost.shift_px += ghost.drift_px
            ghost.scans -= 1
        self._ghosts = [ghost for ghost in self._ghosts if ghost.scans > 0]
        inside = np.asarray(((pixels >= 0) & (pixels < self._size - 1)).all(axis=1))
        points, sigma, valid = self._triangulator.triangulate(np.where(inside[:, None], pixels, scan.pixels), np.full(count, 0.1))
        keep = ~moved | (inside & valid)
        return replace(
            scan,
            points=np.where(moved[:, None], points, scan.points)[keep],
            pixels=pixels[keep],
            intensity=scan.intensity[keep],
            sigma=np.where(moved, sigma, scan.sigma)[keep],
        )

    def _begin(self) -> None:
        rng = self._rng
        if rng.random() < self._rate:
            first, length = rng.uniform(0.0, 0.9), rng.uniform(*SHARE)
            shift_px = rng.uniform(*SHIFT_PX) * rng.choice([-1, 1])
            self._ghosts.append(
                Ghost(int(rng.integers(*SCANS)), first, min(first + length, 1.0), shift_px, DRIFT_PX * rng.normal())
            )


def haunt(frames: Iterable[Image | LaserScan], haunted: Haunted) -> Iterator[Image | LaserScan]:
    """Yield the frames, scans with ghosts; no images, colour plays no part."""
    return (haunted(frame) for frame in frames if isinstance(frame, LaserScan))


def figures(mapper: Mapper, data: Path) -> str:
    """Return what became of the map, in words."""
    points = mapper.map.columns.position[mapper.map.alive()]
    found = surface_figures(surface_distances(points, read_surface(data / "surface.ply")))
    covered, _ = nearest_map_points(read_cloud(data / "seen.ply").points.astype(np.float64), points)
    return (
        f"{len(points)} points, beyond 0.5 mm {found.beyond_0_5mm_percent:.3f} %, 1 mm {found.beyond_1mm_percent:.3f} %; "
        f"point-to-plane {found.map_point_to_plane_rmse_mm:.4f} mm; complete {100 * covered.mean():.2f} %; "
        f"{mapper.counters['points_contradicted']} contradicted, {mapper.counters['points_left_with_piece']} more left"
    )


def main() -> None:
    """Print a line for each rate: nothing contradicted, points alone, and pieces with them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, nargs="?", default=DATA)
    parser.add_argument("--rates", type=float, nargs="+", default=[0.0, 0.05])
    args = parser.parse_args()
    calibration = load_calibration(args.recording / "calibration.yaml")
    frames = [frame for frame in read_frames(args.recording, calibration) if isinstance(frame, LaserScan)]
    for rate in args.rates:
        for text, limits in LIMITS.items():
            config = MappingConfig(map=limits)
            timed = time_with_truth(args.recording, calibration, ERROR_M, config, haunt(frames, Haunted(calibration, rate)))
            print(f"{rate} ghosts a scan, {text}: {figures(timed.mapper, args.recording)}", flush=True)


if __name__ == "__main__":
    main()
