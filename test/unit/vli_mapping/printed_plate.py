"""A printed plate, photographed and scanned from above by a camera whose light travels with it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from mapping_scenes import CAMERA_HEIGHT, SIGMA, calibration, looking_down, stripe

from vli_common.arrays import ByteArray, FloatArray
from vli_common.geometry import pose, so3_exp, transform
from vli_common.types import Image, LaserScan
from vli_mapping.map_keyframes import KeyframeIntake
from vli_mapping.point_map import PointMap

WIDTH, HEIGHT, PITCH = 0.114, 0.076, 0.019
"""Metres: six by four fields of one pitch."""
_PIXEL = 1e-4
CAMERA = calibration().camera
_NOISE = 2.0 * np.random.default_rng(0).normal(size=(CAMERA.height, CAMERA.width))


def unique_print(seed: int = 1) -> ByteArray:
    """Return a print (H, W) of blots, no two parts of which are alike."""
    rng = np.random.default_rng(seed)
    shape = (round(HEIGHT / _PIXEL), round(WIDTH / _PIXEL))
    blots = sum(cv2.GaussianBlur(rng.normal(size=shape), (0, 0), size) * size for size in (2.0, 5.0, 12.0))
    return np.clip(128 + 60 * blots / np.std(blots), 0, 255).astype(np.uint8)


def repeating_print(seed: int = 1) -> ByteArray:
    """Return a print in which every field of one pitch is the same."""
    field = round(PITCH / _PIXEL)
    return np.tile(unique_print(seed)[:field, :field], (round(HEIGHT / PITCH), round(WIDTH / PITCH)))


def labelled_print(seed: int = 1) -> ByteArray:
    """Return equal fields, in each of which a quarter is printed like in no other."""
    result, own = repeating_print(seed), unique_print(seed + 1)
    field, half = round(PITCH / _PIXEL), round(PITCH / _PIXEL / 2)
    for row in range(0, len(result), field):
        for column in range(0, result.shape[1], field):
            where = (slice(row, row + half), slice(column, column + half))
            result[where] = own[where]
    return result


@dataclass(frozen=True)
class Plate:
    """A flat plate at z = 0 of the map, its corner at the origin."""

    texture: ByteArray

    def image(self, T_map_camera: FloatArray, stamp_ns: int = 0) -> Image:
        """Return what a camera sees, bright in the middle."""
        plate = T_map_camera[:3, :3].T @ np.column_stack([np.eye(3)[:, :2] * _PIXEL, -T_map_camera[:3, 3]])
        seen = cv2.warpPerspective(self.texture, CAMERA.matrix @ plate, (CAMERA.width, CAMERA.height), flags=cv2.INTER_LINEAR)
        u, v = np.meshgrid(np.arange(CAMERA.width) - CAMERA.cx, np.arange(CAMERA.height) - CAMERA.cy)
        light = 1.0 / (1.0 + (u**2 + v**2) / CAMERA.fx**2) ** 2
        grey = np.clip(seen * light + np.roll(_NOISE, stamp_ns % 997), 0, 255).astype(np.uint8)
        return Image(stamp_ns, np.repeat(grey[:, :, None], 3, axis=2))

    def scan(self, T_map_camera: FloatArray, stamp_ns: int = 0) -> LaserScan:
        """Return the stripe below a camera, along its x axis."""
        x = np.arange(-0.012, 0.012, 1e-4)
        ray = np.column_stack([x / CAMERA_HEIGHT, np.zeros_like(x), np.ones_like(x)]) @ T_map_camera[:3, :3].T
        points = T_map_camera[:3, 3] - ray * (T_map_camera[2, 3] / ray[:, 2])[:, None]
        local = (points - T_map_camera[:3, 3]) @ T_map_camera[:3, :3]
        return LaserScan(stamp_ns, local, CAMERA.project(local), np.full(len(x), 100.0), np.full(len(x), SIGMA))

    def point_map(self) -> PointMap:
        """Return the map of the whole plate, with its keyframes."""
        result, intake = PointMap(), KeyframeIntake(CAMERA)
        x = np.arange(0.0, WIDTH - _PIXEL, 3e-4)
        for number, y in enumerate(np.arange(0.0, HEIGHT - _PIXEL, 3e-4)):
            points = np.column_stack([x, np.full_like(x, y), np.zeros_like(x)])
            grey = self.texture[round(y / _PIXEL), np.rint(x / _PIXEL).astype(int)]
            normals = np.tile(np.float32([0, 0, 1]), (len(x), 1))
            colours = np.repeat(grey[:, None], 3, axis=1).astype(np.float32)
            result.insert(stripe(points, number, normals=normals, planarity=np.ones(len(x), np.float32), colours=colours))
        for y in np.arange(0.02, HEIGHT - 0.015, 0.01):
            for x_camera in np.arange(0.02, WIDTH - 0.015, 0.01):
                T = looking_down(x_camera, y)
                intake.offer(self.image(T), T, CAMERA_HEIGHT, result)
        intake.learn(result, None)
        return result


def turned(x: float, y: float, angle: float, tilt: float = 0.0) -> FloatArray:
    """Return T_map_camera (4, 4) of a camera that looks down at (x, y), turned about the vertical, and tilted."""
    return (
        looking_down(x, y)
        @ pose(so3_exp(np.array([0.0, 0.0, angle])), np.zeros(3))
        @ pose(so3_exp(np.array([tilt, 0.0, 0.0])), np.zeros(3))
    )


def apart(T: FloatArray, other: FloatArray, where: FloatArray) -> float:
    """Return how far apart two transforms put a point (3,), metres."""
    return float(np.linalg.norm(transform(T, where[None]) - transform(other, where[None])))
