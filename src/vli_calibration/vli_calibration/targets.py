"""A target from what the user types: ``chessboard:9x6:0.005`` and the like, or Kalibr's ``target.yaml``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import yaml

from vli_calibration.boards import AprilGrid, CharucoBoard, Chessboard, Target
from vli_common.errors import InputError

__all__ = ["FORMS", "AprilGrid", "CharucoBoard", "Chessboard", "Target", "parse_target"]

FORMS = (
    "chessboard:COLSxROWS:SQUARE (inner corners, metres), charuco:COLSxROWS:SQUARE:MARKER:DICT (squares), "
    "aprilgrid:COLSxROWS:TAG:SPACING (tags; spacing as a ratio of the tag) or Kalibr's target.yaml"
)
"""The forms of a target, for help texts and errors."""

_LARGEST_BOARD_M = 5.0
_SMALLEST_SQUARE_M = 1e-4
_MOST_COUNTED = 100


def parse_target(text: str) -> Target:
    """Return the target that a text or a Kalibr file describes.

    Raises:
        InputError: the text has another form, or describes a board that cannot be.
    """
    path = Path(text)
    if path.suffix.lower() in (".yaml", ".yml"):
        return _read_kalibr(path)
    kind, *fields = text.strip().split(":")
    if kind.lower() not in _PARSERS:
        raise InputError(f"target '{text}' is of an unknown kind '{kind}', expected {FORMS}")
    names, make = _PARSERS[kind.lower()]
    if len(fields) != len(names):
        raise InputError(f"target '{text}' has {len(fields)} fields after '{kind}', expected {kind.lower()}:{':'.join(names)}")
    return make(fields, f"target '{text}'")


def _chessboard(fields: list[str], source: str) -> Target:
    columns, rows = _counts(fields[0], 3, source)
    return _plausible(Chessboard(columns, rows, _length(fields[1], "square", source)), source)


def _charuco(fields: list[str], source: str) -> Target:
    columns, rows = _counts(fields[0], 3, source)
    square, marker = _length(fields[1], "square", source), _length(fields[2], "marker", source)
    if marker >= square:
        raise InputError(f"{source} has a marker of '{marker:g}' m, expected less than its square of '{square:g}' m")
    name = fields[3].upper() if fields[3].upper().startswith("DICT_") else f"DICT_{fields[3].upper()}"
    dictionaries = {known.upper(): known for known in dir(cv2.aruco) if known.startswith("DICT_")}
    if name not in dictionaries:
        raise InputError(f"{source} names an unknown dictionary '{fields[3]}', expected one of cv2.aruco, such as DICT_4X4_50")
    target = CharucoBoard(columns, rows, square, marker, dictionaries[name])
    markers = columns * rows // 2
    most = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionaries[name])).bytesList)
    if markers > most:
        raise InputError(f"{source} needs '{markers}' markers, '{dictionaries[name]}' has {most}; name a larger dictionary")
    return _plausible(target, source)


def _aprilgrid(fields: list[str], source: str) -> Target:
    columns, rows = _counts(fields[0], 1, source)
    tag, gap = _length(fields[1], "tag", source), _number(fields[2], "spacing", source)
    if not 0 < gap < 2:
        raise InputError(f"{source} has the spacing '{fields[2]}', expected a ratio of the tag's size such as 0.3")
    tags = len(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11).bytesList)
    if columns * rows > tags:
        raise InputError(f"{source} needs '{columns * rows}' tags, the family 36h11 has {tags}")
    return _plausible(AprilGrid(columns, rows, tag, gap), source)


_PARSERS: dict[str, tuple[tuple[str, ...], Callable[[list[str], str], Target]]] = {
    "chessboard": (("COLSxROWS", "SQUARE"), _chessboard),
    "charuco": (("COLSxROWS", "SQUARE", "MARKER", "DICT"), _charuco),
    "aprilgrid": (("COLSxROWS", "TAG", "SPACING"), _aprilgrid),
}


def _read_kalibr(path: Path) -> Target:
    """Return the target of Kalibr's file; its checkerboards count inner corners too."""
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"target file '{path}' does not exist, expected {FORMS}") from None
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"target file '{path}' cannot be read ({reason}), expected Kalibr's target.yaml") from error
    source = f"target file '{path}'"
    if not isinstance(document, dict):
        raise InputError(f"{source} holds '{type(document).__name__}', expected Kalibr's keys, target_type first")
    kind = document.get("target_type")
    if kind == "aprilgrid":
        size = f"{_key(document, 'tagCols', source)}x{_key(document, 'tagRows', source)}"
        return _aprilgrid([size, _key(document, "tagSize", source), _key(document, "tagSpacing", source)], source)
    if kind == "checkerboard":
        size = f"{_key(document, 'targetCols', source)}x{_key(document, 'targetRows', source)}"
        across, down = _key(document, "colSpacingMeters", source), _key(document, "rowSpacingMeters", source)
        if _number(across, "colSpacingMeters", source) != _number(down, "rowSpacingMeters", source):
            raise InputError(f"{source} has squares of '{across}' by '{down}' m, expected rowSpacingMeters = colSpacingMeters")
        return _chessboard([size, across], source)
    raise InputError(f"{source} has the target_type '{kind}', expected aprilgrid or checkerboard")


def _key(document: Mapping[str, Any], key: str, source: str) -> str:
    value = document.get(key)
    if value is None or isinstance(value, bool | dict | list):
        raise InputError(f"{source} has '{value}' for '{key}', expected a number")
    return str(value)


def _counts(text: str, least: int, source: str) -> tuple[int, int]:
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) != 2 or not all(part.strip().isdecimal() and least <= int(part) <= _MOST_COUNTED for part in parts):
        raise InputError(f"{source} has the size '{text}', expected COLSxROWS such as 9x6, each {least} to {_MOST_COUNTED}")
    return int(parts[0]), int(parts[1])


def _number(text: str, name: str, source: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{source} has the {name} '{text}', expected a number")
    return value


def _length(text: str, name: str, source: str) -> float:
    value = _number(text, name, source)
    if not _SMALLEST_SQUARE_M <= value <= _LARGEST_BOARD_M:
        raise InputError(f"{source} has a {name} of '{text}', expected metres, {_SMALLEST_SQUARE_M:g} to {_LARGEST_BOARD_M:g}")
    return value


def _plausible(target: Target, source: str) -> Target:
    """Return the target, having refused a board larger than any: millimetres taken for metres, as a rule."""
    size = max(target.columns, target.rows) * target.spacing
    if size > _LARGEST_BOARD_M:
        raise InputError(f"{source} is a board of '{size:g}' m, expected at most {_LARGEST_BOARD_M:g}; lengths are in metres")
    return target
