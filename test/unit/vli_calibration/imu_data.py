"""Synthetic IMUs, at rest and moving before a board, with known truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from recordings import T, header, image, write

from vli_calibration.boards import Chessboard
from vli_calibration.types import Detection
from vli_common.calibration import ImuCalibration
from vli_common.camera import CameraModel, make_camera
from vli_common.geometry import inverse, pose, so3_exp
from vli_simulation.motion import Trajectory

RATE_HZ = 200.0
START_NS = 1_700_000_000 * 10**9
NOISE = ImuCalibration(RATE_HZ, 2.0e-3, 3.0e-4, 2.4e-4, 2.0e-5)
BOARD = Chessboard(9, 6, 0.005)
GRAVITY = 9.81


def rest(duration_s: float, seed: int, noise: ImuCalibration = NOISE) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps (N,) and values (N, 6) of an IMU that lies still, tilted a little."""
    rng = np.random.default_rng(seed)
    count = int(duration_s * RATE_HZ)
    gyro = errors(rng, count, noise.gyroscope_noise_density, noise.gyroscope_random_walk, 0.006)
    accel = errors(rng, count, noise.accelerometer_noise_density, noise.accelerometer_random_walk, 0.08)
    return START_NS + np.arange(count) * 5_000_000, np.hstack([gyro, accel + np.array([0.3, -0.2, 9.8])])


def errors(rng: np.random.Generator, count: int, white: float, walk: float, bias: float) -> np.ndarray:
    """Return bias, its walk and white noise of three axes."""
    steps = rng.normal(0, walk / np.sqrt(RATE_HZ), (count, 3))
    return rng.normal(0, bias, 3) + np.cumsum(steps, axis=0) + white * np.sqrt(RATE_HZ) * rng.standard_normal((count, 3))


def imu_messages(stamps: np.ndarray, values: np.ndarray, topic: str = "/imu") -> Iterator[tuple[int, str, Any]]:
    """Yield what :func:`recordings.write` takes."""
    vector, zeros = T["geometry_msgs/msg/Vector3"], np.zeros(9)
    orientation = T["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    for ns, row in zip(stamps.tolist(), values.tolist(), strict=True):
        yield (
            ns,
            topic,
            T["sensor_msgs/msg/Imu"](header(ns), orientation, zeros, vector(*row[:3]), zeros, vector(*row[3:]), zeros),
        )


@dataclass(frozen=True)
class Moving:
    """A sensor before a board: frames of the camera, samples of the IMU, and the truth."""

    camera: CameraModel
    frame_stamps: list[int]
    T_cam_board: np.ndarray
    imu_stamps: np.ndarray
    imu_values: np.ndarray
    T_cam_imu: np.ndarray
    timeshift_s: float

    def detections(self, sigma_px: float = 0.15, seed: int = 0) -> list[Detection]:
        """Return the corners of every frame; those outside the image are missing."""
        rng = np.random.default_rng(seed)
        found = []
        for T_cam_board in self.T_cam_board:
            pixels = self.camera.project(BOARD.points @ T_cam_board[:3, :3].T + T_cam_board[:3, 3])
            pixels = pixels + sigma_px * rng.standard_normal(pixels.shape)
            seen = ((pixels > 4) & (pixels < [self.camera.width - 5, self.camera.height - 5])).all(axis=1)
            found.append(Detection(np.flatnonzero(seen), pixels[seen]))
        return found

    def write_bag(self, path: Path) -> Path:
        """Write pictures of the board and the IMU as a bag."""
        raster, origin = BOARD.raster(8000)
        to_metres = np.array([[1 / 8000, 0, origin[0]], [0, 1 / 8000, origin[1]], [0, 0, 1]])
        messages = list(imu_messages(self.imu_stamps, self.imu_values))
        for ns, T_cam_board in zip(self.frame_stamps, self.T_cam_board, strict=True):
            homography = self.camera.matrix @ T_cam_board[:3, [0, 1, 3]] @ to_metres
            # Drawn at four times the size: reduced by averaging, as a sensor does.
            up = np.array([[4, 0, 1.5], [0, 4, 1.5], [0, 0, 1.0]])
            size = (4 * self.camera.width, 4 * self.camera.height)
            large = cv2.warpPerspective(raster, up @ homography, size, flags=cv2.INTER_LINEAR, borderValue=110)
            small = cv2.resize(large, (self.camera.width, self.camera.height), interpolation=cv2.INTER_AREA)
            messages.append((ns, "/camera/image_raw", image(ns, pixels=cv2.GaussianBlur(small, (0, 0), 0.6))))
        write(path, sorted(messages, key=lambda item: item[0]))
        return path


def moving(
    seed: int,
    duration_s: float = 12.0,
    frame_hz: float = 15.0,
    axes: tuple[float, float, float] = (1.0, 1.0, 1.0),
    timeshift_s: float = 0.004,
    gravity: float = GRAVITY,
    lens: bool = True,
) -> Moving:
    """Return a sensor that is turned about its axes (scaled by ``axes``) and moved to and fro before a board."""
    rng = np.random.default_rng(seed)
    size, focal = ((640, 480), 364.0) if lens else ((320, 240), 200.0)
    coefficients = (-0.112, 0.014, 6e-4, -4e-4) if lens else (0.0,) * 4
    camera = make_camera("radtan", (focal, focal, size[0] / 2 - 2, size[1] / 2 + 2), coefficients, size)
    mounting = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    lever = np.array([0.005, -0.007, 0.009]) + rng.normal(0, 3e-3, 3)
    T_cam_imu = pose(so3_exp(rng.normal(0, 0.03, 3)) @ mounting, lever)
    T_world_board = pose(so3_exp(rng.normal(0, 1.0, 3)), np.zeros(3))
    times = np.arange(-1, duration_s + 1, 0.01)
    turn, wander = _oscillation(rng, times, 0.2) * axes, _oscillation(rng, times, 0.01)
    middle = BOARD.points.mean(axis=0)
    R = so3_exp(turn)
    T_board_cam = pose(R, middle + np.einsum("nij,j->ni", R, [0.0, 0.0, -0.08]) + wander)
    trajectory = Trajectory(times, T_world_board @ T_board_cam @ T_cam_imu, inverse(T_cam_imu))
    imu_s = np.arange(-0.2, duration_s + 0.2, 1 / RATE_HZ)
    state = trajectory.imu(imu_s)
    R_world_imu = state.T_world_imu[:, :3, :3]
    force = np.einsum("nji,nj->ni", R_world_imu, state.acceleration + np.array([0.0, 0.0, gravity]))
    gyro = errors(rng, len(imu_s), NOISE.gyroscope_noise_density, NOISE.gyroscope_random_walk, 0.006)
    accel = errors(rng, len(imu_s), NOISE.accelerometer_noise_density, NOISE.accelerometer_random_walk, 0.08)
    frame_s = np.arange(0.01, duration_s, 1 / frame_hz)
    return Moving(
        camera,
        [START_NS + round((t - timeshift_s) * 1e9) for t in frame_s],
        inverse(trajectory.camera_poses(frame_s)) @ T_world_board,
        START_NS + np.rint(imu_s * 1e9).astype(np.int64),
        np.hstack([state.angular_velocity + gyro, force + accel]),
        T_cam_imu,
        timeshift_s,
    )


def _oscillation(rng: np.random.Generator, times: np.ndarray, size: float) -> np.ndarray:
    frequency, phase = rng.uniform(0.2, 1.1, (3, 4)), rng.uniform(0, 2 * np.pi, (3, 4))
    return size / np.sqrt(2) * np.sin(2 * np.pi * frequency * times[:, None, None] + phase).sum(axis=2)
