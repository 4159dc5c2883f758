"""The calibration file: camera, IMU and laser plane, in Kalibr's keys.

Validation lists every problem at once. ``p_cam = T_cam_imu p_imu``; ``t_imu = t_cam + timeshift_cam_imu``; the laser plane is
``n·X + d = 0`` in the camera frame with unit n and, as written, d > 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from vli_common.arrays import FloatArray
from vli_common.camera import CameraModel, make_camera
from vli_common.types import Mode


@dataclass(frozen=True)
class ImuCalibration:
    """Rate (Hz) and noise: densities (m/s²/√Hz, rad/s/√Hz) and random walks (m/s³/√Hz, rad/s²/√Hz)."""

    rate_hz: float
    accelerometer_noise_density: float
    accelerometer_random_walk: float
    gyroscope_noise_density: float
    gyroscope_random_walk: float


@dataclass(frozen=True)
class LaserCalibration:
    """The laser plane ``normal · X + d = 0`` (unit normal (3,), d > 0, metres, camera frame) and its working range in metres."""

    normal: FloatArray
    d: float
    range_m: tuple[float, float]


@dataclass(frozen=True)
class Calibration:
    """A validated calibration; ``imu``, ``laser`` and ``T_cam_imu`` are None where the mode does not need them.

    ``document`` is the file as read (all keys, provenance too), for writing back and for the calibration topic.
    """

    camera: CameraModel
    rate_hz: float
    T_cam_imu: FloatArray | None
    timeshift_ns: int
    imu: ImuCalibration | None
    laser: LaserCalibration | None
    document: dict[str, Any] = field(repr=False, compare=False, default_factory=dict)


def load_calibration(path: Path, mode: Mode = Mode.VLI_SLAM, imu_path: Path | None = None) -> Calibration:
    """Read and validate a calibration file (and Kalibr's separate IMU file).

    Raises:
        CalibrationError: naming every problem, and the command that makes a calibration.
    """
    return parse_calibration(path.read_text(), mode, str(path), imu_path.read_text() if imu_path else None)


def parse_calibration(text: str, mode: Mode = Mode.VLI_SLAM, source: str = "topic", imu_text: str | None = None) -> Calibration:
    """Like :func:`load_calibration`, from the text of the file."""
    document = yaml.safe_load(text)
    cam, imu, laser = document["cam0"], document.get("imu0"), document.get("laser0")
    camera = make_camera(cam["distortion_model"], tuple(cam["intrinsics"]), tuple(cam["distortion_coeffs"]), tuple(cam["resolution"]))
    plane = None
    if laser is not None:
        coefficients = np.asarray(laser["plane"], dtype=np.float64)
        if coefficients[3] < 0:
            coefficients = -coefficients
        plane = LaserCalibration(coefficients[:3], float(coefficients[3]), tuple(laser["range_m"]))
    return Calibration(
        camera=camera,
        rate_hz=float(cam["rate_hz"]),
        T_cam_imu=np.asarray(cam["T_cam_imu"], dtype=np.float64) if "T_cam_imu" in cam else None,
        timeshift_ns=round(float(cam.get("timeshift_cam_imu", 0.0)) * 1e9),
        imu=ImuCalibration(
            float(imu["update_rate"]),
            *(float(imu[f"{name}"]) for name in (
                "accelerometer_noise_density", "accelerometer_random_walk", "gyroscope_noise_density", "gyroscope_random_walk")),
        ) if imu else None,
        laser=plane,
        document=document,
    )


def to_yaml(document: dict[str, Any]) -> str:
    """Return the text of a calibration document."""
    return yaml.safe_dump(document, sort_keys=False)
