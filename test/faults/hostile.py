"""Messages, files and bytes as nobody sane would send them: mutations of good ones, decided by a string of bytes.

The bytes come from hypothesis, which looks for the shortest that still breaks something.
"""

from __future__ import annotations

import array
import copy
import re
import struct
from typing import Any

import numpy as np

INTEGERS = (0, 1, 2, 3, -1, 7, 255, 256, 640, 65535, 65536, 10**9, 2**31 - 1, 2**31, 2**32 - 1, -(2**31))
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-320, 1e-12, 1e6, 1e38, 3.5e38, 1e154, 1e308, -1e308, np.nan, np.inf, -np.inf)
TEXTS = (
    "", "\0", "x" * 70_000, "💥" * 50, "1: a", "-1: a", "4294967296: a", "99999999999999999999: a", "٣: a", "bgr8", "mono8",
    "mono16", "bayer_rggb8", "bayer_grbg16", "rgb16", "16UC1", "jpeg", "png", "nan", "inf", "1e999", "-1", "on", "off", "x", "y",
    "z", "session", "rgb", "data", "id", "TRACKING", "exposure_s", "laser", "state", "1_0", " 1 ", "--set", "../../etc",
)  # fmt: skip
_RANGES = {"int8": (-128, 127), "uint8": (0, 255), "int16": (-(2**15), 2**15 - 1), "uint16": (0, 2**16 - 1)}
_RANGES |= {"int32": (-(2**31), 2**31 - 1), "uint32": (0, 2**32 - 1), "int64": (-(2**63), 2**63 - 1)}
_ARRAY = re.compile(r"(?P<item>.+)\[\d+\]|sequence<(?P<items>[^,>]+)(, \d+)?>")
_NUMBER = re.compile(r"-?\d\.\d+e[+-]\d+")


class Dice:
    """Decisions out of a string of bytes; the first choice of everything once it is used up."""

    def __init__(self, data: bytes) -> None:
        self._data, self._next = data, 0

    def below(self, count: int) -> int:
        """Return a number from 0 to ``count`` − 1."""
        size = 1 if count <= 256 else 4
        chunk = self._data[self._next : self._next + size]
        self._next += size
        return int.from_bytes(chunk, "little") % count if count else 0

    def of(self, choices: Any) -> Any:
        """Return one of a sequence."""
        return choices[self.below(len(choices))]


def mutated(message: Any, dice: Dice) -> Any:
    """Return a copy of a message with one to four of its fields changed, at any depth."""
    message = copy.deepcopy(message)
    for _ in range(1 + dice.below(4)):
        _mutate(message, dice)
    return message


def corrupted(data: bytes, dice: Dice) -> bytes:
    """Return bytes that are cut, stretched, flipped, or overwritten with numbers in places."""
    changed = bytearray(data)
    for _ in range(1 + dice.below(4)):
        place, kind = dice.below(len(changed) + 1), dice.below(6)
        if kind == 0:
            del changed[place:]
        elif kind == 1:
            changed[place:place] = bytes([dice.below(256)]) * (1 + dice.below(300))
        elif kind == 2 and place < len(changed):
            changed[place] ^= 1 << dice.below(8)
        elif kind == 3:
            changed[place : place + 8] = struct.pack("<d", dice.of(FLOATS))
        elif kind == 4:
            number = dice.of(INTEGERS) & 0xFFFFFFFF
            changed[place : place + 4] = struct.pack(dice.of((">I", "<I")), number)
        else:
            del changed[place : place + 1 + dice.below(40)]
    return bytes(changed)


def with_other_numbers(text: str, dice: Dice) -> str:
    """Return an archive of the same form in which up to six of the numbers are others."""
    tokens = text.split(" ")
    places = [index for index, token in enumerate(tokens) if _NUMBER.fullmatch(token)]
    for _ in range(1 + dice.below(6)):
        value = float(dice.of(FLOATS)) * dice.of((1.0, 1e-6, 3.0))
        tokens[dice.of(places)] = f"{value:.17e}"
    return " ".join(tokens)


def _mutate(message: Any, dice: Dice) -> None:
    name, kind = dice.of(sorted(message.get_fields_and_field_types().items()))
    value = getattr(message, name)
    if match := _ARRAY.fullmatch(kind):
        setattr(message, name, _sequence(value, match["item"] or match["items"], match["item"] is not None, dice))
    elif "/" in kind:
        _mutate(value, dice)
    else:
        setattr(message, name, _scalar(kind, dice))


def _scalar(kind: str, dice: Dice) -> Any:
    if kind == "boolean":
        return bool(dice.below(2))
    if kind in ("double", "float"):
        value = dice.of(FLOATS)
        return value if kind == "double" or not 3.4e38 < abs(value) < np.inf else 3.4e38
    if kind == "octet":
        return bytes([dice.below(256)])
    if kind in ("string", "wstring"):
        return dice.of(TEXTS)
    low, high = _RANGES[kind]
    return min(max(dice.of(INTEGERS), low), high)


def _sequence(value: Any, item: str, is_fixed: bool, dice: Dice) -> Any:
    if item == "uint8":
        return array.array("B", corrupted(value.tobytes(), dice))
    if "/" not in item:
        changed = np.array(value)
        changed[dice.below(len(changed))] = _scalar(item, dice)
        return changed if is_fixed else array.array(value.typecode, changed)
    items = list(value)
    if not items or (kind := dice.below(5)) == 0:
        return []
    place = dice.below(len(items))
    if kind == 1:
        del items[place]
    elif kind == 2:
        items.insert(place, copy.deepcopy(dice.of(items)))
    elif kind == 3:
        items *= 1 + dice.below(200)
    else:
        _mutate(items[place], dice)
    return items
