"""The calibration file: camera, IMU and laser plane, in Kalibr's keys.

Validation lists every problem at once. ``p_cam = T_cam_imu p_imu``; ``t_imu = t_cam + timeshift_cam_imu``; the laser plane is
``n·X + d = 0`` in the camera frame with unit n and, as written, d > 0.
"""

from __future__ import annotations

import copy
import difflib
import math
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from vli_common.arrays import FloatArray
from vli_common.camera import MODELS, CameraModel, make_camera
from vli_common.errors import CalibrationError
from vli_common.types import NANOSECONDS, Mode

DEFAULT_RATE_HZ = 60.0
"""Camera rate where ``cam0`` has no ``rate_hz`` (Kalibr writes none)."""

_NOISE_KEYS = (
    "accelerometer_noise_density",
    "accelerometer_random_walk",
    "gyroscope_noise_density",
    "gyroscope_random_walk",
)
_KEYS = {
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

_CAMERA_COMMAND = "vli calibrate camera DIR --target T --out"
_LASER_HINT = "re-run 'vli calibrate laser'"
_SECTION_HINTS = {
    "cam0": "make it with 'vli calibrate camera'",
    "imu0": "make it with 'vli calibrate imu' or pass Kalibr's file with '--imu-calib'",
    "laser0": "make it with 'vli calibrate laser'",
}
_ROTATION_TOLERANCE = 1e-3
_UNIT_TOLERANCE = 1e-3
_MAX_SIDE_PX = 16384


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


@dataclass(frozen=True)
class Calibration:
    """A validated calibration; ``imu``, ``laser`` and ``T_cam_imu`` are None where the file has none.

    ``document`` is the file as read (all keys, provenance too), for writing back and for the calibration topic.
    """

    camera: CameraModel
    rate_hz: float
    T_cam_imu: FloatArray | None
    timeshift_ns: int
    imu: ImuCalibration | None
    laser: LaserCalibration | None
    document: dict[str, Any] = field(repr=False, compare=False, default_factory=dict)


def load_calibration(path: Path, mode: Mode | None = Mode.VLI_SLAM, imu_path: Path | None = None) -> Calibration:
    """Read and validate a calibration file (and Kalibr's separate IMU file).

    Args:
        path: the file.
        mode: what the calibration must be complete for; None where cam0 is enough.
        imu_path: Kalibr's ``imu.yaml``, in place of the section imu0.

    Raises:
        CalibrationError: naming every problem, and the command that makes a calibration.
    """
    text = _read_text(path, f"make one with '{_CAMERA_COMMAND} {path}'")
    imu_text = _read_text(imu_path, "expected Kalibr's imu.yaml") if imu_path else None
    return parse_calibration(text, mode, str(path), imu_text)


def load_document(path: Path) -> dict[str, Any]:
    """Read a calibration file as it stands, complete or not.

    Raises:
        CalibrationError: no such file, or not YAML with sections.
    """
    return _parse_yaml(_read_text(path, f"make one with '{_CAMERA_COMMAND} {path}'"), str(path))


def check_document(document: dict[str, Any], source: str) -> None:
    """Validate the sections that are there, whichever they are.

    Raises:
        CalibrationError: naming every problem.
    """
    problems: list[str] = []
    sections = _sections(document, [], "", problems)
    camera = _camera(sections["cam0"]) if "cam0" in sections else None
    if "imu0" in sections:
        _imu(sections["imu0"])
    if "laser0" in sections:
        _laser(sections["laser0"], camera)
    if problems:
        raise CalibrationError(source, problems)


def parse_calibration(
    text: str, mode: Mode | None = Mode.VLI_SLAM, source: str = "topic", imu_text: str | None = None
) -> Calibration:
    """Like :func:`load_calibration`, from the text of the file."""
    document = _parse_yaml(text, source)
    if imu_text is not None:
        imu_document = _parse_yaml(imu_text, f"{source} (IMU file)")
        document["imu0"] = imu_document.get("imu0", imu_document)
    problems: list[str] = []
    needed_by = f", mode '{mode.value}' needs it" if mode else ""
    sections = _sections(document, _needed(mode), needed_by, problems)
    camera = _camera(sections["cam0"]) if "cam0" in sections else None
    imu = _imu(sections["imu0"]) if "imu0" in sections else None
    laser = _laser(sections["laser0"], camera) if "laser0" in sections else None
    if mode and mode.uses_imu and "cam0" in sections:
        sections["cam0"].missing("T_cam_imu", f"mode '{mode.value}' needs it; make it with 'vli calibrate imu-camera'")
    if problems or camera is None:
        raise CalibrationError(source, problems)
    cam0 = sections["cam0"]
    return Calibration(
        camera=camera,
        rate_hz=cam0.number("rate_hz", DEFAULT_RATE_HZ, positive=True),
        T_cam_imu=cam0.transform("T_cam_imu"),
        timeshift_ns=round(cam0.number("timeshift_cam_imu", 0.0) * NANOSECONDS),
        imu=imu,
        laser=laser,
        document=document,
    )


def to_yaml(document: dict[str, Any]) -> str:
    """Return the text of a calibration document; the laser plane is written with d > 0."""
    document = copy.deepcopy(document)
    laser = document.get("laser0")
    if isinstance(laser, dict) and "plane" in laser:
        plane = np.asarray(laser["plane"], dtype=np.float64)
        laser["plane"] = (-plane if plane[3] < 0 else plane).tolist()
    return yaml.dump(_plain(document), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=130)


class _Dumper(yaml.SafeDumper):
    """Writes a list of scalars on one line, as Kalibr does, and never an anchor."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def represent_sequence(self, tag: str, sequence: Any, flow_style: bool | None = None) -> yaml.SequenceNode:
        flat = not any(isinstance(item, list | dict) for item in sequence)
        return super().represent_sequence(tag, sequence, flow_style=flat)


def _plain(value: Any) -> Any:
    """Return nested containers with numpy values made into Python's own."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


class _Section:
    """Typed access to one section; what is wrong goes to ``problems`` and a harmless value is returned.

    Args:
        name: of the section, prefix of the keys in the messages.
        values: the section as read.
        problems: shared by all sections, in order of discovery.
    """

    def __init__(self, name: str, values: dict[str, Any], problems: list[str]) -> None:
        self.name, self.values, self._problems = name, values, problems

    def complain(self, problem: str) -> None:
        """Add a problem, once."""
        if problem not in self._problems:
            self._problems.append(problem)

    def missing(self, key: str, hint: str = "") -> bool:
        """Return True, and complain, where ``key`` is absent."""
        if self.values.get(key) is not None:
            return False
        self.complain(f"'{self.name}.{key}' is missing" + (f"; {hint}" if hint else ""))
        return True

    def number(self, key: str, default: float | None = None, positive: bool = False) -> float:
        """Return a finite number; a key without ``default`` is required."""
        if self.values.get(key) is None and default is not None:
            return default
        fallback = default if default is not None else 1.0
        if self.missing(key):
            return fallback
        value = _to_float(self.values[key])
        if value is None or not math.isfinite(value) or (positive and value <= 0):
            self.complain(
                f"'{self.name}.{key}' is '{self.values[key]}', expected a {'positive' if positive else 'finite'} number"
            )
            return fallback
        return value

    def numbers(self, key: str, counts: Collection[int], default: list[float] | None = None) -> FloatArray | None:
        """Return finite numbers (n,) with n in ``counts``, or None."""
        values = self.values.get(key)
        if values is None and default is not None:
            values = default
        elif self.missing(key):
            return None
        if not isinstance(values, list | tuple) or len(values) not in counts:
            wanted = " or ".join(str(count) for count in counts)
            self.complain(f"'{self.name}.{key}' is '{values}', expected a list of {wanted} numbers")
            return None
        numbers = [_to_float(value) for value in values]
        bad = [raw for raw, value in zip(values, numbers, strict=True) if value is None or not math.isfinite(value)]
        if bad:
            self.complain(f"'{self.name}.{key}' has '{bad[0]}', expected finite numbers")
            return None
        return np.array(numbers, dtype=np.float64)

    def choice(self, key: str, choices: Collection[str]) -> str | None:
        """Return one of ``choices``, or None."""
        if self.missing(key):
            return None
        value = self.values[key]
        if not isinstance(value, str) or value not in choices:
            self.complain(f"'{self.name}.{key}' is '{value}', expected {' or '.join(choices)}")
            return None
        return value

    def transform(self, key: str) -> FloatArray | None:
        """Return a rigid transform (4, 4) with its rotation made orthonormal, or None."""
        rows = self.values.get(key)
        if rows is None:
            return None
        numbers = [_to_float(value) for row in rows for value in row] if _is_4x4(rows) else []
        if len(numbers) != 16 or not all(value is not None and math.isfinite(value) for value in numbers):
            self.complain(f"'{self.name}.{key}' is '{rows}', expected 4 rows of 4 finite numbers")
            return None
        T = np.array(numbers, dtype=np.float64).reshape(4, 4)
        if not np.allclose(T[3], [0, 0, 0, 1], atol=1e-9):
            self.complain(f"'{self.name}.{key}' has the last row '{T[3].tolist()}', expected [0, 0, 0, 1]")
            return None
        u, singular, vt = np.linalg.svd(T[:3, :3])
        if np.abs(singular - 1).max() > _ROTATION_TOLERANCE or np.linalg.det(T[:3, :3]) < 0:
            deviation = float(np.abs(singular - 1).max())
            self.complain(
                f"'{self.name}.{key}' has no rotation (determinant '{np.linalg.det(T[:3, :3]):.6g}', "
                f"deviation '{deviation:.3g}'), expected an orthonormal right-handed one; re-run 'vli calibrate imu-camera'"
            )
            return None
        T[:3, :3] = u @ vt
        return T


def _read_text(path: Path, hint: str) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise CalibrationError(str(path), [f"no such file; {hint}"]) from None
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(str(path), [f"cannot be read ({error}); {hint}"]) from error


def _parse_yaml(text: str, source: str) -> dict[str, Any]:
    try:
        document = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        raise CalibrationError(source, [f"not YAML{where}: {getattr(error, 'problem', None) or type(error).__name__}"]) from error
    if not isinstance(document, dict):
        found = "nothing" if document is None else type(document).__name__
        raise CalibrationError(
            source, [f"holds '{found}', expected sections {', '.join(_KEYS)}; make one with '{_CAMERA_COMMAND} {source}'"]
        )
    return document


def _needed(mode: Mode | None) -> list[str]:
    return ["cam0"] + (["imu0"] * mode.uses_imu + ["laser0"] * mode.uses_laser if mode else [])


def _sections(document: dict[str, Any], needed: list[str], needed_by: str, problems: list[str]) -> dict[str, _Section]:
    """Return the sections that are there, having checked names, keys, and that all that is needed is present."""
    cameras = sorted(name for name in document if isinstance(name, str) and name.startswith("cam") and name[3:].isdigit())
    if len(cameras) > 1:
        problems.append(f"two cameras ('{', '.join(cameras)}'), expected one; keep the scanner's camera as 'cam0'")
    problems += [_unknown(str(name), _KEYS, "section") for name in document if name not in _KEYS and name not in cameras[1:]]
    problems += [
        f"section '{name}' is missing{needed_by}; {_SECTION_HINTS[name]}" for name in needed if document.get(name) is None
    ]
    sections = {}
    for name, keys in _KEYS.items():
        values = document.get(name)
        if values is None:
            continue
        if not isinstance(values, dict):
            problems.append(f"section '{name}' is '{values}', expected keys {', '.join(keys)}")
            continue
        problems += [_unknown(str(key), keys, "key", f"{name}.") for key in values if key not in keys]
        sections[name] = _Section(name, values, problems)
    return sections


def _camera(section: _Section) -> CameraModel | None:
    section.choice("camera_model", ("pinhole",))
    model = section.choice("distortion_model", MODELS)
    intrinsics = section.numbers("intrinsics", (4,))
    resolution = section.numbers("resolution", (2,))
    coefficients = section.numbers("distortion_coeffs", MODELS[model][1], [] if model == "none" else None) if model else None
    section.number("rate_hz", DEFAULT_RATE_HZ, positive=True)
    section.number("timeshift_cam_imu", 0.0)
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


def _plausible_pinhole(section: _Section, intrinsics: FloatArray, resolution: FloatArray) -> bool:
    fx, fy, cx, cy = intrinsics
    width, height = resolution
    sizes_hold = all(1 <= side <= _MAX_SIDE_PX and side == int(side) for side in resolution)
    focal_holds = fx > 0 and fy > 0
    if not sizes_hold:
        section.complain(f"'{section.name}.resolution' is '{resolution.tolist()}', expected whole pixels, 1 to {_MAX_SIDE_PX}")
    if not focal_holds:
        section.complain(f"'{section.name}.intrinsics' has focal lengths '{fx}, {fy}', expected positive pixels")
    centre_holds = bool(-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5)
    if sizes_hold and not centre_holds:
        section.complain(
            f"'{section.name}.intrinsics' has the principal point '{cx}, {cy}', expected inside "
            f"the image of {int(width)}×{int(height)} px"
        )
    return sizes_hold and focal_holds and centre_holds


def _imu(section: _Section) -> ImuCalibration:
    return ImuCalibration(*(section.number(key, positive=True) for key in ("update_rate", *_NOISE_KEYS)))


def _laser(section: _Section, camera: CameraModel | None) -> LaserCalibration | None:
    plane = section.numbers("plane", (4,))
    limits = section.numbers("range_m", (2,))
    if limits is not None and not 0 < limits[0] < limits[1]:
        section.complain(f"'{section.name}.range_m' is '{limits.tolist()}', expected [near, far] with 0 < near < far, metres")
        limits = None
    if plane is None:
        return None
    norm = float(np.linalg.norm(plane[:3]))
    if abs(norm - 1) > _UNIT_TOLERANCE:
        section.complain(f"laser plane normal has norm '{round(norm, 6)}', expected 1; {_LASER_HINT}")
        return None
    plane = plane / (-norm if plane[3] < 0 else norm)
    if plane[3] == 0:
        section.complain(f"laser plane has d '0.0': it passes through the camera's centre and gives no depth; {_LASER_HINT}")
        return None
    if limits is None:
        return None
    if camera is not None:
        _check_view(section, camera, plane, (float(limits[0]), float(limits[1])))
    return LaserCalibration(plane[:3], float(plane[3]), (float(limits[0]), float(limits[1])))


def _check_view(section: _Section, camera: CameraModel, plane: FloatArray, limits: tuple[float, float]) -> None:
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


def _unknown(name: str, known: Collection[str], what: str, prefix: str = "") -> str:
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.0)
    return f"unknown {what} '{prefix}{name}', did you mean '{near[0]}'?"


def _is_4x4(rows: Any) -> bool:
    return (
        isinstance(rows, list | tuple) and len(rows) == 4 and all(isinstance(row, list | tuple) and len(row) == 4 for row in rows)
    )


def _to_float(value: Any) -> float | None:
    """Return a number, also one that YAML 1.1 reads as a string (``2e-3``); None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        return float(value)
    except (ValueError, OverflowError):
        return None
