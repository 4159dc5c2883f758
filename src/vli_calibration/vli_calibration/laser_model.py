"""Residuals of the joint problem and their derivatives: corners in pixels, stripe points in metres from the laser plane.

The parameters that all views share are the camera's (fx, fy, cx, cy and the coefficients of its lens) and the plane's: two small
rotations of the normal and the distance. Each view adds the six of its board's pose, a right perturbation ``Exp([ω, v])``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.camera import CameraModel
from vli_common.geometry import pose, skew, so3_exp, transform

PLANE_PARAMETERS = 3
_STEP = 1e-6


@dataclass(frozen=True)
class LaserPlane:
    """The plane ``normal · X + d = 0`` in the camera frame, unit normal (3,), d in metres."""

    normal: FloatArray
    d: float

    @classmethod
    def from_vector(cls, plane: FloatArray) -> LaserPlane:
        """Return the plane of four numbers n, d, with a unit normal and d > 0."""
        scale = float(np.linalg.norm(plane[:3])) * (-1.0 if plane[3] < 0 else 1.0)
        return cls(plane[:3] / scale, float(plane[3] / scale))

    @property
    def vector(self) -> FloatArray:
        """(4,) n, d."""
        return np.append(self.normal, self.d)

    @property
    def tangents(self) -> FloatArray:
        """(2, 3) unit vectors across the normal."""
        first = np.eye(3)[int(np.argmin(np.abs(self.normal)))]
        first = first - (first @ self.normal) * self.normal
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(self.normal, first)])

    def distance(self, points: FloatArray) -> FloatArray:
        """Return the signed distance (N,) of points (N, 3)."""
        result: FloatArray = points @ self.normal + self.d
        return result

    def moved(self, step: FloatArray) -> LaserPlane:
        """Return the plane with its normal tilted along the tangents by step[:2] radians, and d changed by step[2]."""
        normal = self.normal + step[:2] @ self.tangents
        return LaserPlane(normal / np.linalg.norm(normal), self.d + float(step[2]))

    def vector_jacobian(self) -> FloatArray:
        """Return the change (4, 3) of :attr:`vector` with a step of :meth:`moved`."""
        jacobian = np.zeros((4, PLANE_PARAMETERS))
        jacobian[:3, :2], jacobian[3, 2] = self.tangents.T, 1.0
        return jacobian


def camera_parameters(camera: CameraModel) -> FloatArray:
    """Return fx, fy, cx, cy and the distortion's coefficients."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.coefficients])


def with_parameters(camera: CameraModel, values: FloatArray) -> CameraModel:
    """Return the camera with other parameters; see :func:`camera_parameters`."""
    fx, fy, cx, cy, *coefficients = map(float, values)
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, coefficients=tuple(coefficients))


def moved_pose(T: FloatArray, step: FloatArray) -> FloatArray:
    """Return T Exp([ω, v]) to first order in v: rotation and translation apart."""
    return pose(T[:3, :3] @ so3_exp(step[:3]), T[:3, 3] + T[:3, :3] @ step[3:])


def corner_residuals(camera: CameraModel, poses: FloatArray, points: FloatArray, pixels: FloatArray) -> FloatArray:
    """Return reprojection errors (K, 2) in pixels.

    Args:
        camera: with its lens.
        poses: (K, 4, 4) T_cam_board of each corner.
        points: (K, 3) in the board frame.
        pixels: (K, 2) raw.
    """
    return camera.project(transform(poses, points)) - pixels


def corner_jacobians(camera: CameraModel, poses: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of projected corners: by the camera (K, 2, C) and by the pose (K, 2, 6)."""
    seen = transform(poses, points)
    rays = seen[:, :2] / seen[:, 2:]
    by_ray, by_camera = pixel_jacobians(camera, rays)
    by_point = np.empty((len(points), 2, 3))
    by_point[:, :, :2] = by_ray / seen[:, 2, None, None]
    by_point[:, :, 2] = -np.einsum("kij,kj->ki", by_ray, rays) / seen[:, 2:]
    turned = by_point @ poses[:, :3, :3]
    return by_camera, np.concatenate([-turned @ skew(points), turned], axis=2)


def pixel_jacobians(camera: CameraModel, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of raw pixels by their rays (N, 2, 2) and by the camera's parameters (N, 2, C); central differences.

    Differences serve every lens model alike, and none has a kink.
    """
    by_ray = [(camera.to_pixels(rays + step) - camera.to_pixels(rays - step)) / (2 * _STEP) for step in _STEP * np.eye(2)]
    values = camera_parameters(camera)
    by_camera = []
    for step in np.diag(_STEP * np.maximum(np.abs(values), 1.0)):
        ends = [with_parameters(camera, values + sign * step).to_pixels(rays) for sign in (-1, 1)]
        by_camera.append((ends[1] - ends[0]) / (2 * step.sum()))
    return np.stack(by_ray, axis=2), np.stack(by_camera, axis=2)


def stripe_points(camera: CameraModel, poses: FloatArray, pixels: FloatArray) -> FloatArray:
    """Return where the viewing rays of raw pixels (M, 2) meet their boards' planes, (M, 3) in the camera frame.

    Args:
        camera: with its lens.
        poses: (M, 4, 4) T_cam_board of each point, or one (4, 4).
        pixels: (M, 2) raw.
    """
    rays = np.column_stack([camera.unproject(pixels), np.ones(len(pixels))])
    normal, offset = poses[..., :3, 2], (poses[..., :3, 2] * poses[..., :3, 3]).sum(axis=-1)
    result: FloatArray = rays * (offset / (rays * normal).sum(axis=1))[:, None]
    return result


def stripe_jacobians(
    camera: CameraModel, poses: FloatArray, points: FloatArray, plane: LaserPlane
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the derivatives of the points' distances from the laser plane: by camera (M, C), plane (M, 3), pose (M, 6).

    Args:
        camera: with its lens.
        poses: (M, 4, 4) T_cam_board of each point.
        points: (M, 3) as :func:`stripe_points` gives them.
        plane: of the laser.
    """
    rays = points[:, :2] / points[:, 2:]
    first, second, facing = (poses[:, :3, k] for k in range(3))
    # X = s r, s = m·t / m·r: a turn about the board's y moves s by a₁·(t − X) / m·r, one about its x by −a₂·(t − X) / m·r.
    gain = (points @ plane.normal) / (points * facing).sum(axis=1)
    lever = poses[:, :3, 3] - points
    by_pose = np.zeros((len(points), 6))
    by_pose[:, 0], by_pose[:, 1], by_pose[:, 5] = -gain * (lever * second).sum(axis=1), gain * (lever * first).sum(axis=1), gain
    by_plane = np.column_stack([points @ plane.tangents.T, np.ones(len(points))])
    # The pixel stays where it is: the ray moves by −(∂p/∂r)⁻¹ ∂p/∂c, and the point along the board with it.
    by_ray, by_parameter = pixel_jacobians(camera, rays)
    by_camera = -np.einsum("mi,mic->mc", distance_by_ray(points, poses, plane), np.linalg.pinv(by_ray) @ by_parameter)
    return by_camera, by_plane, by_pose


def distance_by_ray(points: FloatArray, poses: FloatArray, plane: LaserPlane) -> FloatArray:
    """Return how a point's distance from the laser plane changes with its ray, (M, 2), when it moves along its board."""
    facing = poses[:, :3, 2]
    gain = (points @ plane.normal) / (points * facing).sum(axis=1)
    result: FloatArray = points[:, 2:] * (plane.normal[:2] - gain[:, None] * facing[:, :2])
    return result


def stripe_sigmas(
    camera: CameraModel, poses: FloatArray, points: FloatArray, sigma_px: FloatArray, plane: LaserPlane, axis: int
) -> FloatArray:
    """Return what sigma_px (M,) along image axis 0 (u) or 1 (v) means as a distance (M,) from the laser plane, metres."""
    rays = points[:, :2] / points[:, 2:]
    by_ray = [(camera.to_pixels(rays + step) - camera.to_pixels(rays - step)) / (2 * _STEP) for step in _STEP * np.eye(2)]
    by_pixel = np.linalg.pinv(np.stack(by_ray, axis=2))[:, :, axis]
    result: FloatArray = np.abs((distance_by_ray(points, poses, plane) * by_pixel).sum(axis=1)) * sigma_px
    return result
