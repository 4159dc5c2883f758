"""Compile the kernels of this package before the first frame."""

from __future__ import annotations

import numpy as np

from vli_backend.condense import condense, refine
from vli_backend.config import BackEndConfig
from vli_backend.frame_pose import solve_frame_pose
from vli_backend.landmarks import LandmarkTable
from vli_backend.laser_depth import measure_slot
from vli_backend.map_residuals import condense_map
from vli_backend.window import FrameRecord, close_interval
from vli_common.arrays import FloatArray
from vli_common.types import LaserScan, MapConstraints


def warm_up() -> None:
    """Run every kernel once on a small problem; they are cached on disk, so only the first call after installation is slow."""
    config = BackEndConfig()
    rng = np.random.default_rng(0)
    table = LandmarkTable(config.window_keyframes + 1)
    rays = rng.uniform(-0.3, 0.3, (20, 2))
    ids, restarted = np.arange(1, 21, dtype=np.int64), np.zeros(20, np.bool_)
    whitening = np.tile(1e3 * np.eye(2), (20, 1, 1))
    for _ in range(2):
        table.add_keyframe(ids, rays, whitening, restarted, 30.0)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 0.001
    directions = np.concatenate([rng.uniform(-0.3, 0.3, (50, 2)), np.ones((50, 1))], axis=1)
    scan = LaserScan(0, 0.03 * directions, directions[:, :2], np.ones(50), np.full(50, 5e-5))
    measure_slot(table, 0, poses[0], [(poses[0], scan)], 400.0, config)
    refine(table.arrays, poses, table.usable, 1.0, (2.0, 150.0))
    condense(table.arrays, poses, table.usable, 1.0).in_body_frame(np.eye(4))
    found = table.points(poses)
    solve_frame_pose(poses[0], np.eye(6), found.positions, found.spread, rays, whitening, 1.0)
    _warm_up_map(poses, scan)


def _warm_up_map(poses: FloatArray, scan: LaserScan) -> None:
    """Relate a scan between two keyframes to the map, eq. (4)."""
    between = LaserScan(1, scan.points, scan.pixels, scan.intensity, scan.sigma)
    interval = close_interval([FrameRecord(0, poses[0], False), FrameRecord(2, poses[1], False)], [between])
    count = len(scan)
    normals = np.tile([0.0, 0.0, 1.0], (count, 1))
    stamps, ones = np.ones(count, np.int64), np.ones(count)
    constraints = MapConstraints(2, stamps, scan.points, scan.points, normals, scan.sigma, ones)
    condense_map(constraints, [0, 2], [interval], range(1), poses, 1.0, 2.0)
