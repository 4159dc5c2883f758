"""Poses of a robot arm, as a text file beside the images: three lines an image, or image names alone."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.errors import InputError
from vli_common.geometry import pose, rotation_from_quaternion

_LINES = (("position", 3, "[x, y, z] in metres"), ("quaternion", 4, "[qx, qy, qz, qw]"))
_FORM = "three lines an image: [x, y, z], [qx, qy, qz, qw], name"
_NORM_TOLERANCE = 0.02
"""Files with three decimals are met; the norm of their quaternions is off by some 1e-3."""


def read_poses(path: Path) -> dict[str, FloatArray]:
    """Return T_base_tool (4, 4) by image name; empty for a file that holds image names alone, one a line.

    Empty lines and what follows a ``#`` are passed over.

    Raises:
        InputError: the file cannot be read, or a line is not what its place asks for.
    """
    lines = _lines(path)
    if not any(text.startswith("[") for _, text in lines):
        _names(path, lines)
        return {}
    poses: dict[str, FloatArray] = {}
    for start in range(0, len(lines), 3):
        record = lines[start : start + 3]
        position, quaternion = (
            _numbers(path, record[index], *_LINES[index]) if index < len(record) else _ended(path, lines, _LINES[index][2])
            for index in range(2)
        )
        if len(record) < 3:
            _ended(path, lines, "the name of an image")
        poses[_name(path, record[2], poses)] = pose(_rotation(path, record[1][0], quaternion), position)
    return poses


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return number and text of the lines that say something."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"poses '{path}': no such file; expected {_FORM}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"poses '{path}' cannot be read ({error}); expected {_FORM}") from error
    stripped = ((number, line.partition("#")[0].strip()) for number, line in enumerate(text.splitlines(), start=1))
    lines = [(number, line) for number, line in stripped if line]
    if not lines:
        raise InputError(f"poses '{path}' is empty; expected {_FORM}")
    return lines


def _names(path: Path, lines: list[tuple[int, str]]) -> None:
    seen: set[str] = set()
    for line in lines:
        seen.add(_name(path, line, seen))


def _numbers(path: Path, line: tuple[int, str], what: str, count: int, expected: str) -> FloatArray:
    number, text = line
    try:
        values = [float(item) for item in text.removeprefix("[").removesuffix("]").replace(",", " ").split()]
    except ValueError:
        values = []
    if not (text.startswith("[") and text.endswith("]")) or len(values) != count or not all(map(math.isfinite, values)):
        raise _damaged(path, number, text, f"the {what} {expected}")
    return np.array(values)


def _name(path: Path, line: tuple[int, str], seen: set[str] | dict[str, FloatArray]) -> str:
    number, text = line
    if text.startswith("[") or not Path(text).suffix:
        raise _damaged(path, number, text, "the file name of an image")
    if text in seen:
        raise InputError(f"poses '{path}' line {number}: '{text}' has a pose already; expected each image once")
    return text


def _rotation(path: Path, number: int, quaternion: FloatArray) -> FloatArray:
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > _NORM_TOLERANCE:
        raise InputError(
            f"poses '{path}' line {number}: quaternion of norm '{norm:.4g}', expected 1, in the order [qx, qy, qz, qw]"
        )
    return rotation_from_quaternion(quaternion / norm)


def _damaged(path: Path, number: int, text: str, expected: str) -> InputError:
    return InputError(f"poses '{path}' line {number} is '{text[:60]}', expected {expected}; the form is {_FORM}")


def _ended(path: Path, lines: list[tuple[int, str]], expected: str) -> FloatArray:
    raise InputError(f"poses '{path}' ends after line {lines[-1][0]}, expected {expected}; the form is {_FORM}")
