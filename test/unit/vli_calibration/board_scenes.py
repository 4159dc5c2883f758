"""Boards before a camera: their corners with noise, or pictures of them with blur, glare and a laser stripe."""

from __future__ import annotations

import cv2
import numpy as np

from vli_calibration.targets import Target, parse_target
from vli_common.arrays import ByteArray, FloatArray
from vli_common.camera import CameraModel, make_camera
from vli_common.geometry import inverse, pose, so3_exp

SIZE = (640, 480)
BOARD = parse_target("chessboard:9x6:0.005")
RADTAN4 = make_camera("radtan", (600.0, 602.0, 325.0, 236.0), (-0.25, 0.08, 0.001, -0.0008), SIZE)
RADTAN5 = make_camera("radtan", (640.0, 638.0, 315.0, 247.0), (0.15, -0.9, 0.002, -0.001, 1.5), SIZE)
WIDE = make_camera("equidistant", (310.0, 311.0, 322.0, 238.0), (-0.03, 0.01, -0.005, 0.001), SIZE)
_OVERSAMPLING = 3


def board_pose_at(target: Target, distance: float, tilt: FloatArray, offset: FloatArray, spin: float = 0.0) -> FloatArray:
    """Return T_cam_board with the board's middle at ``offset`` (x, y; share of the distance), tilted by a rotation vector."""
    x0, y0, x1, y1 = target.extent
    centre = np.array([(x0 + x1) / 2, (y0 + y1) / 2, 0.0])
    R = so3_exp(np.array([tilt[0], tilt[1], 0.0])) @ so3_exp(np.array([0.0, 0.0, spin]))
    middle = distance * np.array([offset[0], offset[1], 1.0])
    return pose(R, middle - R @ centre)


def random_poses(
    target: Target, camera: CameraModel, count: int, rng: np.random.Generator, tilt: float = 0.6
) -> list[FloatArray]:
    """Return poses at which all corners are in the image, near and far, tilted to all sides."""
    x0, _, x1, _ = target.extent
    fill = (x1 - x0) * camera.fx / camera.width
    poses: list[FloatArray] = []
    while len(poses) < count:
        distance = fill * rng.uniform(1.3, 2.6)
        offset = rng.uniform(-0.35, 0.35, 2) * np.array([camera.width, camera.height]) / camera.fx
        T = board_pose_at(target, distance, rng.uniform(-tilt, tilt, 2), offset, rng.uniform(-3.1, 3.1))
        pixels = project(camera, T, target.points)
        if np.isfinite(pixels).all() and (pixels > 12).all() and (pixels < np.array([camera.width, camera.height]) - 13).all():
            poses.append(T)
    return poses


def project(camera: CameraModel, T_cam_board: FloatArray, points: FloatArray) -> FloatArray:
    """Return raw pixels (N, 2) of points on the board."""
    return camera.project(points @ T_cam_board[:3, :3].T + T_cam_board[:3, 3])


def picture(
    target: Target,
    camera: CameraModel,
    T_cam_board: FloatArray,
    rng: np.random.Generator,
    black: float = 40.0,
    white: float = 180.0,
    blur_px: float = 0.7,
    noise: float = 2.0,
) -> ByteArray:
    """Return a grey image (H, W) of the board on a white sheet."""
    scale = 40 / target.spacing
    raster, first = target.raster(scale)
    rows, columns = camera.height * _OVERSAMPLING, camera.width * _OVERSAMPLING
    u, v = np.meshgrid((np.arange(columns) + 0.5) / _OVERSAMPLING - 0.5, (np.arange(rows) + 0.5) / _OVERSAMPLING - 0.5)
    rays = camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1))
    directions = np.column_stack([rays, np.ones(len(rays))])
    T_board_cam = inverse(T_cam_board)
    along = directions @ T_board_cam[:3, :3].T
    hit = T_board_cam[:3, 3] - along * (T_board_cam[2, 3] / along[:, 2])[:, None]
    place = ((hit[:, :2] - first) * scale).astype(np.float32).reshape(rows, columns, 2)
    fine = cv2.remap(raster, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderValue=255).astype(np.float32)
    image = cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(black + image / 255 * (white - black), (0, 0), blur_px)
    return np.clip(image + rng.normal(0, noise, image.shape), 0, 255).astype(np.uint8)


def with_stripe(grey: ByteArray, row: float, channel: int = 2, width_px: float = 4.0) -> ByteArray:
    """Return the image as BGR with a bright horizontal laser line, its colour in one channel, glowing a little in the others."""
    v = np.arange(grey.shape[0])[:, None]
    line = 255 * np.exp(-0.5 * ((v - row) / width_px) ** 2) + 25 * np.exp(-np.abs(v - row) / 40)
    colour = np.repeat(grey[:, :, None], 3, axis=2).astype(np.float64)
    share = np.full(3, 0.35)
    share[channel] = 1.0
    return np.clip(colour + line[:, :, None] * share, 0, 255).astype(np.uint8)


def with_glare(grey: ByteArray, centre: tuple[float, float], radius_px: float, strength: float) -> ByteArray:
    """Return the image with a soft patch of light on it."""
    v, u = np.indices(grey.shape[:2])
    patch = strength * np.exp(-0.5 * ((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / radius_px**2)
    return np.clip(grey + patch, 0, 255).astype(np.uint8)
