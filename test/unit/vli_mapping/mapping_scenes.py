"""Synthetic surfaces and scans for the tests of the mapping stage."""

from __future__ import annotations

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration
from vli_common.camera import make_camera
from vli_common.types import FrameKind, Image, LaserScan, WindowPoses
from vli_mapping.point_map import PointMap, Stripe

SIGMA = 3e-5
FRAME_NS = 16_666_667
CAMERA_HEIGHT = 0.03


def calibration() -> Calibration:
    """Return a camera without distortion; the mapping stage asks for nothing else."""
    camera = make_camera("none", (360.0, 360.0, 319.5, 239.5), (), (640, 480))
    return Calibration(camera, 60.0, np.eye(4), 0, None, None)


def looking_down(x: float, y: float, z: float = CAMERA_HEIGHT) -> FloatArray:
    """Return T_map_camera (4, 4) of a camera at (x, y, z) that looks along −z of map."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = x, y, z
    return T


def step_height(y: FloatArray) -> FloatArray:
    """Return z (N,) of a plate with a gentle 2 mm step: a surface that constrains two directions."""
    return 2e-3 / (1 + np.exp(-(y - 0.01) / 8e-4))


def scan_of(stamp_ns: int, T_map_camera: FloatArray, y: float, half_width: float = 0.012, seed: int | None = None) -> LaserScan:
    """Return a stripe along x at ``y`` (map) of the stepped plate, as a camera at T_map_camera measures it."""
    x = np.arange(-half_width, half_width, 8e-5)
    points = np.stack([x + T_map_camera[0, 3], np.full_like(x, y), step_height(np.full_like(x, y))], axis=1)
    local = (points - T_map_camera[:3, 3]) @ T_map_camera[:3, :3]
    if seed is not None:
        ray = local / np.linalg.norm(local, axis=1, keepdims=True)
        local = local + ray * np.random.default_rng(seed).normal(size=(len(local), 1)) * SIGMA
    pixels = local[:, :2] / local[:, 2:] * 360 + [319.5, 239.5]
    return LaserScan(stamp_ns, local, pixels, np.full(len(x), 100.0), np.full(len(x), SIGMA))


def stripe(points: FloatArray, number: int = 0, **changes: object) -> Stripe:
    """Return a stripe of map points, solid, grey, without normals, seen from above, but for ``changes``."""
    count = len(points)
    columns: dict[str, object] = {
        "stamp_ns": number * 2 * FRAME_NS,
        "number": number,
        "T_map_camera": looking_down(*points.mean(axis=0)[:2], points[:, 2].mean() + CAMERA_HEIGHT),
        "points": np.asarray(points, np.float64),
        "normals": np.zeros((count, 3), np.float32),
        "planarity": np.zeros(count, np.float32),
        "colours": np.full((count, 3), 100, np.float32),
        "sigma": np.full(count, SIGMA),
        "solid": np.ones(count, np.bool_),
    }
    return Stripe(**{**columns, **changes})  # type: ignore[arg-type]


def sheet(point_map: PointMap, rows: int = 40, spacing: float = 3e-4, first_number: int = 0) -> None:
    """Insert rows of a flat sheet at z = 0, one stripe a row."""
    x = np.arange(rows) * spacing
    for row in range(rows):
        points = np.stack([x, np.full_like(x, row * spacing), np.zeros_like(x)], axis=1)
        point_map.insert(stripe(points, first_number + row))


def long_image(stamp_ns: int, bgr: tuple[int, int, int] = (40, 80, 120)) -> Image:
    """Return an image of one colour."""
    return Image(stamp_ns, np.full((480, 640, 3), bgr, np.uint8))


def window(
    stamps: list[int],
    kinds: list[FrameKind],
    poses: list[FloatArray],
    final: bool = True,
    redundant: bool = False,
    session: int = 0,
) -> WindowPoses:
    """Return the poses of frames that are all final, or all not."""
    count = len(stamps)
    codes = np.array([kind.value for kind in kinds], np.uint8)
    return WindowPoses(
        stamps[-1], np.array(stamps), codes, np.full(count, final), np.full(count, redundant), np.stack(poses), session
    )
