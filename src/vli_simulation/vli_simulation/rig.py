"""The simulated instrument: camera, laser sheet, light and IMU, with the exact calibration it is written with.

Its small misalignments are drawn from the seed: no two instruments are alike, and none is perfectly square.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.camera import CameraModel, make_camera
from vli_common.geometry import pose, so3_exp
from vli_simulation.config import SimulationConfig

_FOCAL_OF_WIDTH = 0.567
_LENSES = {"radtan": (-0.112, 0.014, 6e-4, -4e-4), "equidistant": (-0.021, 0.006, -0.002, 4e-4), "none": (0.0, 0.0, 0.0, 0.0)}
_LASER_RESPONSE = {"red": (0.012, 0.07, 1.0), "blue": (1.0, 0.10, 0.015)}
_LASER_TILT_DEG = 0.8
_LENS_SPREAD = 0.08
_R_CAM_IMU = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class LaserSheet:
    """The laser: a sheet of light from a line generator.

    Args:
        origin: (3,) where the sheet leaves the laser, camera frame, metres; lies in the plane.
        normal, d: the plane n · X + d = 0, d > 0, camera frame.
        centre: (3,) unit, central direction of the fan.
        across: (3,) unit, in the plane and perpendicular to ``centre``: along the stripe.
        response: (3,) of the sensor's blue, green and red to its colour.
        half_fan: half the opening angle of the fan, radians.
    """

    origin: FloatArray
    normal: FloatArray
    d: float
    centre: FloatArray
    across: FloatArray
    response: FloatArray
    half_fan: float

    def fan(self, count: int) -> FloatArray:
        """Return ``count`` directions (count, 3) of length 1 within the sheet, evenly spaced in tan of the fan's angle."""
        tangent = np.linspace(-np.tan(self.half_fan), np.tan(self.half_fan), count)
        directions = self.centre + tangent[:, None] * self.across
        result: FloatArray = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        return result


@dataclass(frozen=True)
class Rig:
    """Everything that is rigidly connected; ``light`` is the LED's position (3,) in the camera frame, looking along z."""

    camera: CameraModel
    T_cam_imu: FloatArray
    laser: LaserSheet
    light: FloatArray
    document: dict[str, Any]


def make_rig(config: SimulationConfig, seed: int, spread: float = 1.0) -> Rig:
    """Return the instrument of a seed, with its calibration document.

    Args:
        config: what it is made of.
        seed: of its misalignments.
        spread: scales them; 1 for parts of one batch, 0 for the drawing itself.
    """
    rng = np.random.default_rng([seed, 1])
    intrinsics = _intrinsics(config, rng, spread)
    coefficients = _coefficients(config, seed, spread)
    camera = make_camera(config.rig.lens, intrinsics, coefficients, (config.rig.width, config.rig.height))
    T_cam_imu = pose(
        so3_exp(spread * rng.normal(0, np.deg2rad(0.8), 3)) @ _R_CAM_IMU,
        np.array([0.005, -0.007, 0.009]) + spread * rng.normal(0, 1e-3, 3),
    )
    laser = _make_laser(config, rng, spread)
    light = np.array([-0.005, -0.006, 0.001]) if abs(config.rig.stripe_angle_deg) < 45 else np.array([-0.006, 0.005, 0.001])
    return Rig(camera, T_cam_imu, laser, light, _document(config, intrinsics, coefficients, T_cam_imu, laser))


def _coefficients(config: SimulationConfig, seed: int, spread: float) -> tuple[float, ...]:
    """Return the lens of the drawing, unless parts differ by more than those of one batch."""
    drawn = np.array(_LENSES[config.rig.lens])
    wider = _LENS_SPREAD * max(spread - 1.0, 0.0) * np.random.default_rng([seed, 19]).uniform(-1, 1, len(drawn))
    return tuple(np.round(drawn * (1 + wider), 6).tolist())


def _intrinsics(config: SimulationConfig, rng: np.random.Generator, spread: float) -> tuple[float, float, float, float]:
    width, height = config.rig.width, config.rig.height
    focal = _FOCAL_OF_WIDTH * width * (1 + spread * 0.01 * rng.standard_normal())
    cx = 0.5 * (width - 1) + spread * 0.006 * width * rng.standard_normal()
    cy = 0.5 * (height - 1) + spread * 0.006 * width * rng.standard_normal()
    values = (focal, focal * (1 + spread * 0.001 * rng.standard_normal()), cx, cy)
    fx, fy, cx, cy = (round(float(value), 3) for value in values)
    return fx, fy, cx, cy


def _make_laser(config: SimulationConfig, rng: np.random.Generator, spread: float) -> LaserSheet:
    angle = np.deg2rad(config.rig.stripe_angle_deg)
    along, perpendicular = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
    origin = config.rig.baseline * perpendicular + np.array([0.0, 0.0, 0.001])
    crossing = np.array([0.0, 0.0, 1.15 * config.motion.distance])
    tilt = so3_exp(spread * rng.normal(0, np.deg2rad(_LASER_TILT_DEG), 3))
    centre = tilt @ (crossing - origin) / np.linalg.norm(crossing - origin)
    across = tilt @ along
    normal = np.cross(across, centre)
    normal /= np.linalg.norm(normal)
    d = -float(normal @ origin)
    if d < 0:
        normal, d = -normal, -d
    return LaserSheet(origin, normal, d, centre, across, np.array(_LASER_RESPONSE[config.rig.laser_colour]), np.deg2rad(44.0))


def _document(
    config: SimulationConfig,
    intrinsics: tuple[float, ...],
    coefficients: tuple[float, ...],
    T_cam_imu: FloatArray,
    laser: LaserSheet,
) -> dict[str, Any]:
    imu = config.imu
    return {
        "cam0": {
            "camera_model": "pinhole",
            "intrinsics": list(intrinsics),
            "distortion_model": config.rig.lens,
            "distortion_coeffs": list(coefficients),
            "resolution": [config.rig.width, config.rig.height],
            "rate_hz": config.rig.rate_hz,
            "T_cam_imu": T_cam_imu.tolist(),
            "timeshift_cam_imu": 0.0,
        },
        "imu0": {
            "update_rate": imu.rate_hz,
            "accelerometer_noise_density": imu.accelerometer_noise_density,
            "accelerometer_random_walk": imu.accelerometer_random_walk,
            "gyroscope_noise_density": imu.gyroscope_noise_density,
            "gyroscope_random_walk": imu.gyroscope_random_walk,
        },
        "laser0": {"plane": [*laser.normal.tolist(), laser.d], "range_m": [0.02, 0.15]},
    }
