"""The calibration file: camera, IMU and laser plane, in Kalibr's keys.

Validation lists every problem at once. ``p_cam = T_cam_imu p_imu``; ``t_imu = t_cam + timeshift_cam_imu``; the laser plane is
``n·X + d = 0`` in the camera frame with unit n and, as written, d > 0.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from vli_common.arrays import FloatArray
from vli_common.calibration_checks import (
    DEFAULT_RATE_HZ,
    KEYS,
    ImuCalibration,
    LaserCalibration,
    camera_of,
    imu_of,
    laser_of,
    rate_of,
    sections_of,
    timeshift_of,
)
from vli_common.camera import CameraModel
from vli_common.errors import CalibrationError, InputError
from vli_common.types import NANOSECONDS, Mode
from vli_common.yaml_text import load_yaml

__all__ = [
    "DEFAULT_RATE_HZ",
    "Calibration",
    "ImuCalibration",
    "LaserCalibration",
    "check_document",
    "load_calibration",
    "load_document",
    "parse_calibration",
    "to_yaml",
]

_CAMERA_COMMAND = "vli calibrate camera DIR --target T --out"
_BLIND = (0.25, 8.0)
"""Seconds and frame periods, of which the longer counts."""


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

    @property
    def blind_s(self) -> float:
        """Seconds without a long frame beyond which the motion meanwhile is unknown: a hand trembles at 4 to 12 Hz."""
        return max(_BLIND[0], _BLIND[1] / self.rate_hz)


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
    hint = f"make one with '{_CAMERA_COMMAND} {path}'"
    return _parse_yaml(_read_text(path, hint), str(path), f"expected sections {', '.join(KEYS)}; {hint}")


def check_document(document: dict[str, Any], source: str) -> None:
    """Validate the sections that are there, whichever they are.

    Raises:
        CalibrationError: naming every problem.
    """
    problems: list[str] = []
    sections = sections_of(document, [], "", problems)
    camera = camera_of(sections["cam0"]) if "cam0" in sections else None
    if "imu0" in sections:
        imu_of(sections["imu0"])
    if "laser0" in sections:
        laser_of(sections["laser0"], camera)
    if problems:
        raise CalibrationError(source, problems)


def parse_calibration(
    text: str, mode: Mode | None = Mode.VLI_SLAM, source: str = "topic", imu_text: str | None = None
) -> Calibration:
    """Like :func:`load_calibration`, from the text of the file, which need not come from anyone trusted."""
    document = _parse_yaml(text, source, f"expected sections {', '.join(KEYS)}; make one with '{_CAMERA_COMMAND} {source}'")
    if imu_text is not None:
        imu_document = _parse_yaml(imu_text, f"{source} (IMU file)", "expected Kalibr's imu.yaml")
        document["imu0"] = imu_document.get("imu0", imu_document)
    problems: list[str] = []
    needed_by = f", mode '{mode.value}' needs it" if mode else ""
    sections = sections_of(document, _needed(mode), needed_by, problems)
    camera = camera_of(sections["cam0"]) if "cam0" in sections else None
    imu = imu_of(sections["imu0"]) if "imu0" in sections else None
    laser = laser_of(sections["laser0"], camera) if "laser0" in sections else None
    if mode and mode.uses_imu and "cam0" in sections:
        sections["cam0"].missing("T_cam_imu", f"mode '{mode.value}' needs it; make it with 'vli calibrate imu-camera'")
    if problems or camera is None:
        raise CalibrationError(source, problems)
    cam0 = sections["cam0"]
    return Calibration(
        camera=camera,
        rate_hz=rate_of(cam0),
        T_cam_imu=cam0.transform("T_cam_imu"),
        timeshift_ns=round(timeshift_of(cam0) * NANOSECONDS),
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
        """Never refer back, whatever occurs twice."""
        return True

    def represent_sequence(self, tag: str, sequence: Any, flow_style: bool | None = None) -> yaml.SequenceNode:
        """Write what holds no containers on one line."""
        flat = not any(isinstance(item, list | dict) for item in sequence)
        return super().represent_sequence(tag, sequence, flow_style=flat)


def _plain(value: Any) -> Any:
    """Return nested containers with numpy values made into Python's own."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _read_text(path: Path, hint: str) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise CalibrationError(str(path), [f"no such file; {hint}"]) from None
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(str(path), [f"cannot be read ({error}); {hint}"]) from error


def _parse_yaml(text: str, source: str, expected: str) -> dict[str, Any]:
    try:
        document = load_yaml(text)
    except InputError as error:
        raise CalibrationError(source, [f"{error}; {expected}"]) from error
    if not isinstance(document, dict):
        found = "nothing" if document is None else type(document).__name__
        raise CalibrationError(source, [f"holds '{found}', {expected}"])
    return document


def _needed(mode: Mode | None) -> list[str]:
    return ["cam0"] + (["imu0"] * mode.uses_imu + ["laser0"] * mode.uses_laser if mode else [])
