"""A synthetic scan without images: a wavy surface, a hand-held motion with analytic IMU, tracks and stripes with known truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import gtsam
import numpy as np

from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration, ImuCalibration, LaserCalibration
from vli_common.camera import RadtanCamera
from vli_common.geometry import inverse, pose, so3_exp, so3_log, transform
from vli_common.types import FrontEndOutput, ImuBias, LaserScan, Preintegration, TrackFlag, Tracks

LONG_NS = 33_333_333
SHORT_NS = LONG_NS // 2
CAMERA = RadtanCamera(360.0, 361.0, 321.0, 238.0, (0.0, 0.0, 0.0, 0.0), 640, 480)
T_CAM_IMU = pose(so3_exp(np.array([0.02, -0.03, 1.5])), np.array([-0.004, 0.006, 0.008]))
_NORMAL = np.array([0.03, -0.94, -0.34]) / np.linalg.norm([0.03, -0.94, -0.34])


def calibration() -> Calibration:
    """Return the calibration of the synthetic scanner."""
    return Calibration(
        CAMERA,
        60.0,
        T_CAM_IMU,
        0,
        ImuCalibration(200.0, 2e-3, 3e-4, 2.4e-4, 2e-5),
        LaserCalibration(_NORMAL, 0.0118, (0.02, 0.15)),
    )


def surface_height(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return z of the surface, metres: gentle waves of some millimetres."""
    result: FloatArray = 0.003 * np.sin(90 * x) * np.cos(70 * y) + 0.002 * np.sin(200 * x + 1)
    return result


def hit(origins: FloatArray, directions: FloatArray) -> FloatArray:
    """Return where rays (N, 3) meet the surface from above."""
    distance = -origins[:, 2] / directions[:, 2]
    for _ in range(50):
        point = origins + distance[:, None] * directions
        distance = distance - (point[:, 2] - surface_height(point[:, 0], point[:, 1])) / directions[:, 2] * 0.8
    return origins + distance[:, None] * directions


@dataclass
class Motion:
    """Camera looking down at 35 mm, moving along x at 14 mm/s with tremor; at rest for ``rest_s`` first."""

    rest_s: float = 1.0
    speed: float = 0.014
    tremor: float = 1.0

    def _ease(self, t: float) -> float:
        moving = max(0.0, t - self.rest_s)
        return moving - (1 - np.exp(-4 * moving)) / 4 if self.rest_s > 0 else moving

    def camera(self, t: float) -> FloatArray:
        """Return ``T_map_camera`` (4, 4) at ``t`` seconds."""
        s = self._ease(t)
        a = 4e-4 * self.tremor
        position = np.array(
            [self.speed * s, a * np.sin(11 * s) + 0.002 * np.sin(1.3 * s), 0.035 + a * np.sin(9 * s + 0.3) - a * np.sin(0.3)]
        )
        tilt = so3_exp(0.02 * self.tremor * np.array([np.sin(7 * s), np.sin(5 * s), np.sin(6 * s)]))
        down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
        return pose(tilt @ down, position)

    def imu_pose(self, t: float) -> FloatArray:
        """Return ``T_map_imu`` at ``t`` seconds."""
        return self.camera(t) @ T_CAM_IMU

    def imu(self, t: float) -> tuple[FloatArray, FloatArray]:
        """Return noise-free angular rate and specific force at ``t``, by central differences."""
        h = 1e-3
        before, now, after = (self.imu_pose(t + d) for d in (-h, 0.0, h))
        rate = so3_log(before[:3, :3].T @ after[:3, :3]) / (2 * h)
        acceleration = (before[:3, 3] - 2 * now[:3, 3] + after[:3, 3]) / h**2
        return rate, now[:3, :3].T @ (acceleration + np.array([0.0, 0.0, 9.81]))


@dataclass
class Scan:
    """Generates what the front end and the stripe stage would say; truth beside it.

    Args:
        motion: of the camera.
        seed: of features and noise.
        start_s: where in the motion to begin.
        with_imu: False leaves the preintegration out.
    """

    motion: Motion = field(default_factory=Motion)
    seed: int = 0
    start_s: float = 0.0
    pixel_noise: float = 0.1
    with_imu: bool = True
    gyro_bias: FloatArray = field(default_factory=lambda: np.array([0.004, -0.003, 0.002]))
    accel_bias: FloatArray = field(default_factory=lambda: np.array([0.05, -0.04, 0.03]))
    bias: ImuBias = field(default_factory=lambda: ImuBias(0, np.zeros(3), np.zeros(3)))

    def frames(self, duration_s: float) -> Iterator[FrontEndOutput | LaserScan]:
        """Yield long frames and scans in time order."""
        rng = np.random.default_rng(self.seed)
        ids, points = np.empty(0, np.int64), np.empty((0, 3))
        next_id, keyframe_ns = 1, -1
        params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
        params.setAccelerometerCovariance(np.eye(3) * 0.02**2)
        params.setGyroscopeCovariance(np.eye(3) * 5e-4**2)
        params.setBiasAccCovariance(np.eye(3) * 6e-4**2)
        params.setBiasOmegaCovariance(np.eye(3) * 4e-5**2)
        params.setIntegrationCovariance(np.eye(3) * 1e-10)
        for k in range(int(duration_s * 1e9) // LONG_NS):
            stamp = 1_000_000_000 + round(self.start_s * 1e9) + k * LONG_NS
            t = stamp * 1e-9 - 1.0
            T = self.motion.camera(t)
            pixels, inside = self._project(T, points)
            ids, points, pixels = ids[inside], points[inside], pixels[inside]
            moving = t > self.motion.rest_s
            since = stamp - keyframe_ns
            keyframe = keyframe_ns < 0 or since > (0.25e9 if moving else 2e9)
            flags = np.zeros(len(ids), np.uint8)
            preintegration = self._preintegrate(params, keyframe_ns, stamp) if keyframe_ns >= 0 and self.with_imu else None
            if keyframe:
                new = self._detect(T, pixels, rng)
                points = np.concatenate([points, new])
                ids = np.concatenate([ids, np.arange(next_id, next_id + len(new))])
                flags = np.concatenate([flags, np.full(len(new), TrackFlag.NEW, np.uint8)])
                next_id += len(new)
                keyframe_ns = stamp
                pixels = self._project(T, points)[0]
            observed = pixels + rng.normal(scale=self.pixel_noise, size=pixels.shape)
            count = len(ids)
            yield FrontEndOutput(
                Tracks(
                    stamp,
                    keyframe,
                    not moving,
                    ids,
                    observed,
                    CAMERA.unproject(observed),
                    np.zeros((count, 2)),
                    np.full(count, self.pixel_noise),
                    np.full(count, np.inf),
                    flags,
                ),
                preintegration,
            )
            yield self._stripe(stamp + SHORT_NS, rng)

    def truth(self, stamp_ns: int) -> FloatArray:
        """Return the true ``T_map_camera`` at a stamp."""
        return self.motion.camera(stamp_ns * 1e-9 - 1.0)

    def _project(self, T: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        pixels = CAMERA.project(transform(inverse(T), points)) if len(points) else np.empty((0, 2))
        inside = (pixels > 12).all(axis=1) & (pixels < [CAMERA.width - 12, CAMERA.height - 12]).all(axis=1)
        return pixels, inside

    def _detect(self, T: FloatArray, pixels: FloatArray, rng: np.random.Generator) -> FloatArray:
        grid = np.stack(np.meshgrid(np.arange(40, 620, 58), np.arange(40, 460, 45)), axis=-1).reshape(-1, 2) + rng.uniform(
            -8, 8, (100, 2)
        )
        if len(pixels):
            grid = grid[np.linalg.norm(grid[:, None] - pixels[None], axis=2).min(axis=1) > 30]
        rays = np.concatenate([CAMERA.unproject(grid), np.ones((len(grid), 1))], axis=1)
        return hit(np.repeat(T[None, :3, 3], len(grid), axis=0), rays @ T[:3, :3].T)

    def _stripe(self, stamp: int, rng: np.random.Generator) -> LaserScan:
        T = self.truth(stamp)
        origin = -0.0118 * _NORMAL
        forward = np.array([0, 0, 1.0]) - _NORMAL * _NORMAL[2]
        forward /= np.linalg.norm(forward)
        angle = np.linspace(-0.7, 0.7, 500)[:, None]
        directions = np.cos(angle) * forward + np.sin(angle) * np.cross(_NORMAL, forward)
        world = hit(np.repeat((T[:3, :3] @ origin + T[:3, 3])[None], len(angle), axis=0), directions @ T[:3, :3].T)
        points = transform(inverse(T), world)
        pixels = CAMERA.project(points)
        inside = (pixels > 0).all(axis=1) & (pixels < [CAMERA.width, CAMERA.height]).all(axis=1)
        points, pixels = points[inside], pixels[inside]
        sigma = 4e-5 * (points[:, 2] / 0.03) ** 2
        points = points * (1 + rng.normal(size=len(points)) * sigma / points[:, 2])[:, None]
        return LaserScan(stamp, points, pixels, np.full(len(points), 100.0), sigma)

    def _preintegrate(self, params: gtsam.PreintegrationCombinedParams, start: int, end: int) -> Preintegration:
        pim = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias(self.bias.accel, self.bias.gyro))
        steps = max(1, round((end - start) / 5e6))
        dt = (end - start) * 1e-9 / steps
        for k in range(steps):
            rate, force = self.motion.imu(start * 1e-9 - 1.0 + (k + 0.5) * dt)
            pim.integrateMeasurement(force + self.accel_bias, rate + self.gyro_bias, dt)
        return Preintegration(end, start, pim)
