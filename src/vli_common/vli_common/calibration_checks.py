"""What the sections of a calibration file must hold: names, keys, and values that a scanner can have."""

from __future__ import annotations

import difflib
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.calibration_section import Range, Section, shown
from vli_common.camera import MODELS, CameraModel, make_camera

DEFAULT_RATE_HZ = 60.0
"""Camera rate where ``cam0`` has no ``rate_hz`` (Kalibr writes none)."""

_NOISE_KEYS = (
    "accelerometer_noise_density",
    "accelerometer_random_walk",
    "gyroscope_noise_density",
    "gyroscope_random_walk",
)
KEYS = {
    "cam0": (
        "camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution", "rate_hz", "T_cam_imu",
        "timeshift_cam_imu", "provenance", "cam_overlaps", "rostopic", "T_cn_cnm1", "T_cn_cnm",
    ),
    "imu0": (
        "update_rate", *_NOISE_KEYS, "provenance", "rostopic", "model", "time_offset", "T_i_b", "accelerometers", "gyroscopes",
    ),
    "laser0": ("plane", "range_m", "provenance"),
}  # fmt: skip
"""Valid keys of each section; the last ones of cam0 and imu0 are what Kalibr writes beside them: accepted and kept."""

_LASER_HINT = "re-run 'vli calibrate laser'"
_SECTION_HINTS = {
    "cam0": "make it with 'vli calibrate camera'",
    "imu0": "make it with 'vli calibrate imu' or pass Kalibr's file with '--imu-calib'",
    "laser0": "make it with 'vli calibrate laser'",
}
_UNIT_TOLERANCE = 1e-3
_MAX_SIDE_PX = 16384
_MOST_UNKNOWN = 10

# Wide enough for any sensor, and narrow enough that no square, inverse or product of them leaves the range of a double.
_CAMERA_RATE = Range(0.1, 1e4, "Hz")
_IMU_RATE = Range(1, 1e5, "Hz")
_TIMESHIFT = Range(-10, 10, "s")
_NOISE = Range(1e-12, 1e3, "in SI units per √Hz")
_FOCAL_PX = Range(1, 1e6, "px")
_DISTANCE = Range(1e-4, 100, "m")


@dataclass(frozen=True)
class ImuCalibration:
    """Rate (Hz), noise densities (m/s²/√Hz, rad/s/√Hz) and random walks (m/s³/√Hz, rad/s²/√Hz)."""

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


def sections_of(document: dict[str, Any], needed: list[str], needed_by: str, problems: list[str]) -> dict[str, Section]:
    """Return the sections that are there, having checked names, keys, and that all that is needed is present.

    Args:
        document: the file.
        needed: names of sections.
        needed_by: who needs them, for the message.
        problems: gets what is wrong.
    """
    cameras = sorted(name for name in document if isinstance(name, str) and name.startswith("cam") and name[3:].isdigit())
    if len(cameras) > 1:
        problems.append(f"two cameras ('{shown(', '.join(cameras))}'), expected one; keep the scanner's camera as 'cam0'")
    problems += _unknown([name for name in document if name not in cameras[1:]], KEYS, "section")
    problems += [
        f"section '{name}' is missing{needed_by}; {_SECTION_HINTS[name]}" for name in needed if document.get(name) is None
    ]
    sections = {}
    for name, keys in KEYS.items():
        values = document.get(name)
        if values is None:
            continue
        if not isinstance(values, dict):
            problems.append(f"section '{name}' is '{shown(values)}', expected keys {', '.join(keys)}")
            continue
        problems += _unknown(list(values), keys, "key", f"{name}.")
        sections[name] = Section(name, values, problems)
    return sections


def camera_of(section: Section) -> CameraModel | None:
    """Return the camera of ``cam0``, None where the section does not describe one."""
    section.choice("camera_model", ("pinhole",))
    model = section.choice("distortion_model", MODELS)
    intrinsics = section.numbers("intrinsics", (4,))
    resolution = section.numbers("resolution", (2,))
    coefficients = section.numbers("distortion_coeffs", MODELS[model][1], [] if model == "none" else None) if model else None
    rate_of(section)
    timeshift_of(section)
    section.transform("T_cam_imu")
    if model is None or intrinsics is None or resolution is None or coefficients is None:
        return None
    if not _plausible_pinhole(section, intrinsics, resolution):
        return None
    size = (int(resolution[0]), int(resolution[1]))
    camera = make_camera(model, tuple(intrinsics.tolist()), tuple(coefficients.tolist()), size)
    if not camera.is_invertible():
        section.complain(
            f"'{section.name}.distortion_coeffs' is '{coefficients.tolist()}', which folds the image over itself; "
            f"re-run 'vli calibrate camera'"
        )
        return None
    return camera


def rate_of(section: Section) -> float:
    """Return the camera's rate of ``cam0``, Hz."""
    return section.number("rate_hz", _CAMERA_RATE, DEFAULT_RATE_HZ)


def timeshift_of(section: Section) -> float:
    """Return the time shift of ``cam0``, seconds: ``t_imu = t_cam + timeshift``."""
    return section.number("timeshift_cam_imu", _TIMESHIFT, 0.0)


def imu_of(section: Section) -> ImuCalibration:
    """Return what ``imu0`` says; harmless values where it is wrong."""
    return ImuCalibration(section.number("update_rate", _IMU_RATE), *(section.number(key, _NOISE) for key in _NOISE_KEYS))


def laser_of(section: Section, camera: CameraModel | None) -> LaserCalibration | None:
    """Return the plane of ``laser0``, None where it gives no depth; with a camera, it must be in view."""
    plane = section.numbers("plane", (4,))
    limits = _limits(section)
    if plane is None:
        return None
    norm = float(np.linalg.norm(plane[:3]))
    if not abs(norm - 1) <= _UNIT_TOLERANCE:
        section.complain(f"laser plane normal has norm '{round(norm, 6)}', expected 1; {_LASER_HINT}")
        return None
    plane = plane / (-norm if plane[3] < 0 else norm)
    if plane[3] == 0:
        section.complain(f"laser plane has d '0.0': it passes through the camera's centre and gives no depth; {_LASER_HINT}")
        return None
    if limits is None:
        return None
    if camera is not None:
        _check_view(section, camera, plane, limits)
    return LaserCalibration(plane[:3], float(plane[3]), limits)


def _limits(section: Section) -> tuple[float, float] | None:
    limits = section.numbers("range_m", (2,))
    if limits is None:
        return None
    near, far = limits.tolist()
    if not (near < far and near in _DISTANCE and far in _DISTANCE):
        section.complain(f"'{section.name}.range_m' is '{limits.tolist()}', expected [near, far] with near < far, {_DISTANCE}")
        return None
    return near, far


def _plausible_pinhole(section: Section, intrinsics: FloatArray, resolution: FloatArray) -> bool:
    fx, fy, cx, cy = intrinsics
    width, height = resolution
    sizes_hold = all(1 <= side <= _MAX_SIDE_PX and side == int(side) for side in resolution)
    focal_holds = fx in _FOCAL_PX and fy in _FOCAL_PX
    if not sizes_hold:
        section.complain(f"'{section.name}.resolution' is '{resolution.tolist()}', expected whole pixels, 1 to {_MAX_SIDE_PX}")
    if not focal_holds:
        section.complain(f"'{section.name}.intrinsics' has focal lengths '{fx}, {fy}', expected positive pixels: {_FOCAL_PX}")
    centre_holds = bool(-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5)
    if sizes_hold and not centre_holds:
        section.complain(
            f"'{section.name}.intrinsics' has the principal point '{cx}, {cy}', expected inside "
            f"the image of {int(width)}×{int(height)} px"
        )
    return sizes_hold and focal_holds and centre_holds


def _check_view(section: Section, camera: CameraModel, plane: FloatArray, limits: tuple[float, float]) -> None:
    """Complain where no pixel sees the plane between ``limits``; depth by eq. (1)."""
    rays = camera.unproject(camera.pixel_grid())
    slope = rays @ plane[:2] + plane[2]
    depth = np.divide(-plane[3], slope, out=np.full(len(rays), -np.inf), where=slope != 0)
    if not (depth > 0).any():
        section.complain(f"laser plane '{plane.tolist()}' lies behind the camera, expected in front; {_LASER_HINT}")
    elif not ((depth >= limits[0]) & (depth <= limits[1])).any():
        section.complain(
            f"laser plane '{plane.tolist()}' does not meet the view between {limits[0]} and {limits[1]} m; {_LASER_HINT}"
        )


def _unknown(names: list[Any], known: Collection[str], what: str, prefix: str = "") -> list[str]:
    """Return a line for each name that is not known, with the nearest that is; for the first ones only."""
    strange = [str(name) for name in names if name not in known]
    lines = []
    for name in strange[:_MOST_UNKNOWN]:
        near = difflib.get_close_matches(name[:80], list(known), n=1, cutoff=0.0)
        lines.append(f"unknown {what} '{prefix}{shown(name)}', did you mean '{near[0]}'?")
    more = len(strange) - len(lines)
    return [*lines, f"and '{more}' more unknown names"] if more else lines
