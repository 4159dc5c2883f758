"""Typed access to one section of a calibration file, which collects what is wrong with it instead of stopping at the first."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from vli_common.arrays import FloatArray

_ROTATION_TOLERANCE = 1e-3
_SHOWN_CHARACTERS = 120


@dataclass(frozen=True, slots=True)
class Range:
    """Values that a number may have, in words as well as in figures."""

    minimum: float
    maximum: float
    unit: str

    def __contains__(self, value: float) -> bool:
        """Return True within the limits; never for NaN."""
        return self.minimum <= value <= self.maximum

    def __str__(self) -> str:
        """Return the limits and their unit."""
        return f"{self.minimum:g} to {self.maximum:g} {self.unit}"


class Section:
    """One section; what is wrong goes to ``problems`` and a harmless value is returned.

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

    def number(self, key: str, valid: Range, default: float | None = None) -> float:
        """Return a number within ``valid``; a key without ``default`` is required."""
        fallback = default if default is not None else valid.maximum
        if (default is not None and self.values.get(key) is None) or self.missing(key):
            return fallback
        value = to_float(self.values[key])
        if value is None or value not in valid:
            self.complain(f"'{self.name}.{key}' is '{shown(self.values[key])}', expected {valid}")
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
            self.complain(f"'{self.name}.{key}' is '{shown(values)}', expected a list of {wanted} numbers")
            return None
        numbers = [to_float(value) for value in values]
        bad = [raw for raw, value in zip(values, numbers, strict=True) if value is None or not math.isfinite(value)]
        if bad:
            self.complain(f"'{self.name}.{key}' has '{shown(bad[0])}', expected finite numbers")
            return None
        return np.array(numbers, dtype=np.float64)

    def choice(self, key: str, choices: Collection[str]) -> str | None:
        """Return one of ``choices``, or None."""
        if self.missing(key):
            return None
        value = self.values[key]
        if not isinstance(value, str) or value not in choices:
            self.complain(f"'{self.name}.{key}' is '{shown(value)}', expected {' or '.join(choices)}")
            return None
        return value

    def transform(self, key: str) -> FloatArray | None:
        """Return a rigid transform (4, 4) with its rotation made orthonormal, or None."""
        rows = self.values.get(key)
        if rows is None:
            return None
        numbers = [to_float(value) for row in rows for value in row] if _is_4x4(rows) else []
        if len(numbers) != 16 or not all(value is not None and math.isfinite(value) for value in numbers):
            self.complain(f"'{self.name}.{key}' is '{shown(rows)}', expected 4 rows of 4 finite numbers")
            return None
        T = np.array(numbers, dtype=np.float64).reshape(4, 4)
        if not np.allclose(T[3], [0, 0, 0, 1], atol=1e-9):
            self.complain(f"'{self.name}.{key}' has the last row '{T[3].tolist()}', expected [0, 0, 0, 1]")
            return None
        return self._with_rotation(key, T)

    def _with_rotation(self, key: str, T: FloatArray) -> FloatArray | None:
        # The determinant of a matrix of huge numbers overflows; so it is left to those that are nearly orthonormal.
        u, singular, vt = np.linalg.svd(T[:3, :3])
        deviation = float(np.abs(singular - 1).max())
        determinant = float(np.linalg.det(T[:3, :3])) if deviation < 1 else math.nan
        if deviation > _ROTATION_TOLERANCE or determinant < 0:
            self.complain(
                f"'{self.name}.{key}' has no rotation (determinant '{determinant:.6g}', deviation '{deviation:.3g}'), "
                "expected an orthonormal right-handed one; re-run 'vli calibrate imu-camera'"
            )
            return None
        T[:3, :3] = u @ vt
        return T


def shown(value: Any) -> str:
    """Return a value as text for a message, cut where it is long."""
    text = str(value)
    return text if len(text) <= _SHOWN_CHARACTERS else text[:_SHOWN_CHARACTERS] + "…"


def to_float(value: Any) -> float | None:
    """Return a number, also one that YAML 1.1 reads as a string (``2e-3``); None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        return float(value)
    except (ValueError, OverflowError):
        return None


def _is_4x4(rows: Any) -> bool:
    return (
        isinstance(rows, list | tuple) and len(rows) == 4 and all(isinstance(row, list | tuple) and len(row) == 4 for row in rows)
    )
