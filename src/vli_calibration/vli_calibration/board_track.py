"""The board as a moving camera sees it: a pose and its information for every frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vli_calibration.board_pose import board_pose
from vli_calibration.types import Detection
from vli_common.arrays import BoolArray, FloatArray, IntArray
from vli_common.camera import CameraModel
from vli_common.geometry import skew
from vli_common.types import NANOSECONDS

_RAY_STEP = 1e-6
_LEAST_SIGMA_PX = 0.03
"""No detector is better; keeps perfect synthetic corners from weighing infinitely."""
_OUTLIER_SIGMAS = 4.0
_NEIGHBOURS = 3
_STEADY_RAD, _STEADY_RATE = 0.5, 4.0
"""Radians, and radians a second, that a board may turn from frame to frame."""


@dataclass(frozen=True)
class BoardTrack:
    """Poses of the board in F frames.

    Args:
        stamps_ns: (F,) int64, increasing, camera clock.
        T_cam_board: (F, 4, 4).
        roots: (F, 6, 6) upper triangular W: W ξ is what the corners say of ``T_cam_board Exp(ξ)``, ξ = [ω, v], unit variance.
        corners: per frame, ids and raw pixels of the corners that count.
        sigma_px: standard deviation of a corner's coordinate, from the residuals.
    """

    stamps_ns: IntArray
    T_cam_board: FloatArray
    roots: FloatArray
    corners: tuple[Detection, ...]
    sigma_px: float

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def select(self, chosen: BoolArray) -> BoardTrack:
        """Return the frames that are chosen (F,)."""
        corners = tuple(corners for corners, keep in zip(self.corners, chosen, strict=True) if keep)
        return BoardTrack(self.stamps_ns[chosen], self.T_cam_board[chosen], self.roots[chosen], corners, self.sigma_px)

    def residuals_px(self, camera: CameraModel, points: FloatArray, T_cam_board: FloatArray) -> list[FloatArray]:
        """Return the reprojection errors (K, 2) of each frame for given poses (F, 4, 4) and board points (N, 3)."""
        return [
            camera.project(points[corners.ids] @ T[:3, :3].T + T[:3, 3]) - corners.pixels
            for corners, T in zip(self.corners, T_cam_board, strict=True)
        ]


def track_board(
    stamps_ns: list[int], detections: list[Detection], camera: CameraModel, points: FloatArray, turn: FloatArray | None = None
) -> BoardTrack:
    """Return the poses of the board; frames whose corners tell none are left out.

    Args:
        stamps_ns, detections: of each frame in which the board was found.
        camera: calibrated.
        points: (N, 3) corners in the board frame.
        turn: where the board looks the same turned by 180°, T_board_turned (4, 4); the turn is kept from frame to frame.
    """
    stamps, poses, kept = list[int](), list[FloatArray](), list[Detection]()
    for stamp_ns, detection in zip(stamps_ns, detections, strict=True):
        found = board_pose(camera, points[detection.ids], detection.pixels)
        if found is None:
            continue
        T, detection = found.T_cam_board, Detection(detection.ids[found.kept], detection.pixels[found.kept])
        if turn is not None and poses and _angle(poses[-1], T @ turn) < _angle(poses[-1], T):
            T, detection = T @ turn, _turned(detection, len(points))
        stamps.append(stamp_ns)
        poses.append(T)
        kept.append(detection)
    steady = _steady(np.array(stamps, dtype=np.int64), np.array(poses).reshape(-1, 4, 4))
    stamps = [stamp_ns for stamp_ns, keep in zip(stamps, steady, strict=True) if keep]
    poses = [T for T, keep in zip(poses, steady, strict=True) if keep]
    kept = [detection for detection, keep in zip(kept, steady, strict=True) if keep]
    T_cam_board = np.array(poses).reshape(-1, 4, 4)
    kept, sigma_px = _without_outliers(kept, T_cam_board, camera, points)
    roots = np.array([_root(camera, points[c.ids], T, sigma_px) for c, T in zip(kept, T_cam_board, strict=True)]).reshape(
        -1, 6, 6
    )
    return BoardTrack(np.array(stamps, dtype=np.int64), T_cam_board, roots, tuple(kept), sigma_px)


def _steady(stamps_ns: IntArray, T_cam_board: FloatArray) -> BoolArray:
    """Return which frames (F,) show a board turned much as in most of their neighbours: corners numbered wrongly do not."""
    count = len(stamps_ns)
    steady = np.ones(count, dtype=bool)
    for index in range(count):
        first, last = max(0, index - _NEIGHBOURS), min(count, index + _NEIGHBOURS + 1)
        others = [other for other in range(first, last) if other != index]
        apart_s = np.abs(stamps_ns[others] - stamps_ns[index]) / NANOSECONDS
        angles = np.array([_angle(T_cam_board[index], T_cam_board[other]) for other in others])
        like = angles < _STEADY_RAD + _STEADY_RATE * apart_s
        steady[index] = like.sum() >= 0.5 * len(others)
    return steady


def _without_outliers(
    detections: list[Detection], T_cam_board: FloatArray, camera: CameraModel, points: FloatArray
) -> tuple[list[Detection], float]:
    """Return the corners that fit their frame's pose, and the standard deviation of a coordinate."""
    if not detections:
        return [], _LEAST_SIGMA_PX
    errors = [
        camera.project(points[d.ids] @ T[:3, :3].T + T[:3, 3]) - d.pixels for d, T in zip(detections, T_cam_board, strict=True)
    ]
    sigma_px = max(_LEAST_SIGMA_PX, 1.4826 * float(np.median(np.abs(np.concatenate(errors)))))
    fits = [np.linalg.norm(error, axis=1) < _OUTLIER_SIGMAS * sigma_px for error in errors]
    kept = [Detection(d.ids[fit], d.pixels[fit]) for d, fit in zip(detections, fits, strict=True)]
    inside = np.concatenate([error[fit] for error, fit in zip(errors, fits, strict=True)])
    coordinates, poses = inside.size, 6 * len(detections)
    return kept, max(_LEAST_SIGMA_PX, float(np.sqrt((inside**2).sum() / max(coordinates - poses, 1))))


def _root(camera: CameraModel, points: FloatArray, T: FloatArray, sigma_px: float) -> FloatArray:
    """Return the square root of the information that corners give the pose, by QR of their Jacobian."""
    seen = points @ T[:3, :3].T + T[:3, 3]
    rays = seen[:, :2] / seen[:, 2:]
    lens = np.stack(
        [(camera.to_pixels(rays + s) - camera.to_pixels(rays - s)) / (2 * _RAY_STEP) for s in _RAY_STEP * np.eye(2)], 2
    )
    pinhole = np.zeros((len(points), 2, 3))
    pinhole[:, 0, 0] = pinhole[:, 1, 1] = 1 / seen[:, 2]
    pinhole[:, :, 2] = -rays / seen[:, 2:]
    motion = T[:3, :3] @ np.concatenate([-skew(points), np.broadcast_to(np.eye(3), (len(points), 3, 3))], axis=2)
    jacobian = (lens @ pinhole @ motion).reshape(-1, 6)
    return np.linalg.qr(np.vstack([jacobian, np.zeros((6, 6))]) / sigma_px)[1]


def _angle(first: FloatArray, second: FloatArray) -> float:
    return float(np.arccos(np.clip(0.5 * (np.trace(first[:3, :3].T @ second[:3, :3]) - 1), -1, 1)))


def _turned(detection: Detection, count: int) -> Detection:
    return Detection(count - 1 - detection.ids[::-1], detection.pixels[::-1])
