"""A textured plane under a light that travels with the camera: images, IMU and exact truth without a renderer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np

from vli_common.arrays import ByteArray, FloatArray
from vli_common.calibration import Calibration, ImuCalibration
from vli_common.camera import RadtanCamera
from vli_common.geometry import inverse, pose, so3_exp, so3_log, transform
from vli_common.types import Image, ImuSample

LONG_NS = 33_333_333
IMU_NS = 5_000_000
START_NS = 1_000_000_000
CAMERA = RadtanCamera(200.0, 201.0, 159.0, 121.0, (-0.1, 0.02, 0.0005, -0.0005), 320, 240)
T_CAM_IMU = pose(so3_exp(np.array([0.02, -0.03, 1.5])), np.array([-0.004, 0.006, 0.008]))
_METRES_PER_TEXEL = 8e-5
_TEXELS = 1600


def calibration(timeshift_ns: int = 0) -> Calibration:
    """Return the calibration of the synthetic scanner."""
    return Calibration(CAMERA, 60.0, T_CAM_IMU, timeshift_ns, ImuCalibration(200.0, 2e-3, 3e-4, 2.4e-4, 2e-5), None)


def texture(seed: int = 0, size: int = _TEXELS) -> ByteArray:
    """Return (size, size) uint8 noise with structure of 4 to 40 texels."""
    rng = np.random.default_rng(seed)
    total = np.zeros((size, size), np.float32)
    for sigma in (3.0, 6.0, 20.0):
        layer = cv2.GaussianBlur(rng.standard_normal((size, size)).astype(np.float32), (0, 0), sigma)
        total += layer / layer.std()
    return np.clip(128 + 18 * total, 0, 255).astype(np.uint8)


@dataclass
class PlanarScene:
    """A camera 40 mm above the plane z = 0, at rest for ``rest_s``, then along x with tremor.

    Args:
        rest_s: before it moves.
        speed: m/s.
        falloff: of the on-board light towards the corner of the image, 0 to 1.
    """

    rest_s: float = 0.0
    speed: float = 0.03
    falloff: float = 0.6
    gyro_bias: FloatArray = field(default_factory=lambda: np.zeros(3))
    seed: int = 0

    def __post_init__(self) -> None:
        self._texture = texture(self.seed)
        v, u = (grid.ravel() for grid in np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float64))
        self._rays = np.column_stack([CAMERA.unproject(np.column_stack([u, v])), np.ones(len(u))])
        radius = np.hypot(u - CAMERA.cx - 40, v - CAMERA.cy) / np.hypot(CAMERA.cx, CAMERA.cy)
        self._light = (1 - self.falloff * np.minimum(radius, 1.2) ** 2).reshape(CAMERA.height, CAMERA.width)

    def camera(self, stamp_ns: int) -> FloatArray:
        """Return T_map_camera (4, 4)."""
        s = max(0.0, (stamp_ns - START_NS) * 1e-9 - self.rest_s)
        s = s - (1 - np.exp(-8 * s)) / 8 if self.rest_s > 0 else s
        position = np.array([self.speed * s - 0.02, 4e-4 * np.sin(9 * s), 0.04 + 3e-4 * np.sin(7 * s)])
        tilt = so3_exp(0.02 * np.array([np.sin(5 * s), np.sin(6 * s), np.sin(4 * s)]))
        return pose(tilt @ np.diag([1.0, -1.0, -1.0]), position)

    def points(self, stamp_ns: int, rays: FloatArray) -> FloatArray:
        """Return where rays (N, 2) of the camera meet the plane, (N, 3)."""
        T = self.camera(stamp_ns)
        directions = np.column_stack([rays, np.ones(len(rays))]) @ T[:3, :3].T
        return T[:3, 3] - directions * (T[2, 3] / directions[:, 2:])

    def pixels(self, stamp_ns: int, points: FloatArray) -> FloatArray:
        """Return the pixels (N, 2) of points (N, 3)."""
        return CAMERA.project(transform(inverse(self.camera(stamp_ns)), points))

    def image(self, stamp_ns: int) -> Image:
        """Return the picture, grey."""
        points = self.points(stamp_ns, self._rays[:, :2])
        texel = (points[:, :2] / _METRES_PER_TEXEL + _TEXELS / 2).astype(np.float32).reshape(CAMERA.height, CAMERA.width, 2)
        albedo = cv2.remap(self._texture.astype(np.float32), texel[..., 0], texel[..., 1], cv2.INTER_LANCZOS4)
        return Image(stamp_ns, np.clip(albedo * self._light, 0, 255).astype(np.uint8))

    def imu(self, stamp_ns: int) -> ImuSample:
        """Return a noise-free sample, by central differences."""
        h = 1_000_000
        before, now, after = (self.camera(stamp_ns + d) @ T_CAM_IMU for d in (-h, 0, h))
        rate = so3_log(before[:3, :3].T @ after[:3, :3]) / (2e-9 * h)
        acceleration = (before[:3, 3] - 2 * now[:3, 3] + after[:3, 3]) / (1e-9 * h) ** 2
        return ImuSample(stamp_ns, rate + self.gyro_bias, now[:3, :3].T @ (acceleration + np.array([0, 0, 9.81])))

    def items(self, frames: int) -> Iterator[Image | ImuSample]:
        """Yield images and IMU samples in time order; the IMU begins 50 ms before and ends 5 ms after the images."""
        last = START_NS + (frames - 1) * LONG_NS
        images = [START_NS + k * LONG_NS for k in range(frames)]
        samples = list(range(START_NS - 50_000_000, last + 2 * IMU_NS, IMU_NS))
        for stamp_ns, is_image in sorted([(s, True) for s in images] + [(s, False) for s in samples]):
            yield self.image(stamp_ns) if is_image else self.imu(stamp_ns)
