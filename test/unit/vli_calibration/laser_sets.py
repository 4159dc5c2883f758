"""Synthetic views of a board with a laser stripe on it, as pixels and as drawn images."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vli_calibration.boards import Chessboard
from vli_calibration.laser_joint import LaserView
from vli_calibration.laser_model import LaserPlane, with_parameters
from vli_common.arrays import ByteArray, FloatArray
from vli_common.camera import CameraModel, RadtanCamera
from vli_common.geometry import inverse, pose, so3_exp

BOARD = Chessboard(9, 6, 0.005)
CAMERA = RadtanCamera(420.0, 421.0, 322.0, 238.0, (-0.1, 0.02, 0.0005, -0.0003), 640, 480)
PLANE = LaserPlane.from_vector(np.array([0.02, -0.9, -0.43, 0.0145]))


@dataclass(frozen=True)
class Noise:
    """Standard deviations: of a corner and of a stripe point, pixels."""

    corner_px: float = 0.15
    stripe_px: float = 0.2


def board_poses(count: int, rng: np.random.Generator, tilt_rad: float = 0.5) -> list[FloatArray]:
    """Return T_cam_board of boards that the laser crosses in the middle of the image's upper half, 40 to 110 mm away."""
    poses = []
    for _ in range(count):
        depth = rng.uniform(0.04, 0.11)
        rotation = so3_exp(np.array([*rng.uniform(-tilt_rad, tilt_rad, 2), rng.uniform(-0.4, 0.4)]))
        centre = np.array([rng.uniform(-0.2, 0.2) * depth, 0.0, depth])
        centre[1] = -(PLANE.normal[0] * centre[0] + PLANE.normal[2] * centre[2] + PLANE.d) / PLANE.normal[1]
        middle = BOARD.points.mean(axis=0) + rng.uniform(-0.01, 0.01, 3) * [1, 1, 0]
        poses.append(pose(rotation, centre - rotation @ middle))
    return poses


def stripe_pixels(camera: CameraModel, plane: LaserPlane, T_cam_board: FloatArray, count: int = 150) -> FloatArray:
    """Return pixels (count, 2) of the line in which the laser plane meets the board."""
    normal = T_cam_board[:3, 2]
    direction = np.cross(normal, plane.normal)
    direction /= np.linalg.norm(direction)
    rows = np.stack([normal, plane.normal, direction])
    middle = T_cam_board[:3, :3] @ BOARD.points.mean(axis=0) + T_cam_board[:3, 3]
    start = np.linalg.solve(rows, [normal @ T_cam_board[:3, 3], -plane.d, direction @ middle])
    return camera.project(start + np.linspace(-0.02, 0.02, count)[:, None] * direction)


def views(count: int, seed: int, noise: Noise | None = None, tilt_rad: float = 0.5) -> list[LaserView]:
    """Return views with noise, their poses off by what a first estimate is off."""
    noise, rng = noise or Noise(), np.random.default_rng(seed)
    result = []
    for index, T in enumerate(board_poses(count, rng, tilt_rad)):
        corners = CAMERA.project(BOARD.points @ T[:3, :3].T + T[:3, 3])
        stripe = stripe_pixels(CAMERA, PLANE, T)
        stripe[:, 1] += noise.stripe_px * rng.normal(size=len(stripe))
        off = pose(so3_exp(2e-3 * rng.normal(size=3)), 1e-4 * rng.normal(size=3))
        result.append(
            LaserView(
                f"{index:03d}.png",
                BOARD.points,
                corners + noise.corner_px * rng.normal(size=corners.shape),
                stripe,
                np.full(len(stripe), noise.stripe_px),
                1.0,
                T @ off,
            )
        )
    return result


def disturbed_camera() -> CameraModel:
    """Return the camera as a calibration of its own would give it."""
    return with_parameters(CAMERA, np.array([421.0, 421.8, 321.2, 238.7, -0.101, 0.021, 0.0004, -0.0002]))


def drawn(
    T_cam_board: FloatArray,
    seed: int = 0,
    laser: int | None = 2,
    plane: LaserPlane = PLANE,
    vertical: bool = False,
    white: float = 90.0,
) -> ByteArray:
    """Return an image (480, 640, 3) of the board on white paper; the stripe in channel ``laser``, None: the laser is off.

    The stripe's light counts by what it falls on; where it is brightest it is overexposed.
    """
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:480, 0:640]
    rays = np.column_stack([CAMERA.unproject(np.column_stack([u.ravel(), v.ravel()]).astype(float)), np.ones(u.size)])
    scale = (T_cam_board[:3, 2] @ T_cam_board[:3, 3]) / (rays @ T_cam_board[:3, 2])
    points = rays * scale[:, None]
    T = inverse(T_cam_board)
    xy = (points @ T[:3, :3].T + T[:3, 3])[:, :2]
    raster, corner = BOARD.raster(20000.0)
    sheet = cv2.remap(
        raster,
        *((xy - corner) * 20000.0).astype(np.float32).T.reshape(2, 480, 640),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=255,
    )  # fmt: skip
    albedo = 0.08 + 0.92 * cv2.GaussianBlur(sheet.astype(np.float64) / 255, (0, 0), 0.8)
    image = np.repeat((white * albedo)[:, :, None], 3, axis=2)
    if laser is not None:
        distance = plane.distance(points).reshape(480, 640)
        slope = np.abs(np.gradient(distance, axis=1 if vertical else 0))
        light = 260 * albedo * np.exp(-0.5 * (distance / np.maximum(slope, 1e-9) / 2.2) ** 2)
        image += light[:, :, None] * [1.0 if channel == laser else 0.12 for channel in range(3)]
    return np.clip(np.rint(image + 2 * rng.normal(size=image.shape)), 0, 255).astype(np.uint8)
