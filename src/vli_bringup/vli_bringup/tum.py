"""Trajectories as TUM text: ``t x y z qx qy qz qw``, seconds and metres, one pose a line, ``#`` for a comment."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from vli_common.arrays import FloatArray, IntArray
from vli_common.errors import InputError
from vli_common.geometry import pose, rotation_from_quaternion
from vli_common.types import NANOSECONDS

_FIELDS = "t x y z qx qy qz qw"
_QUATERNION_TOLERANCE = 1e-2


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses of the camera in one fixed frame.

    Args:
        stamps_ns: (N,) int64, strictly increasing.
        poses: (N, 4, 4) float64, ``T_fixed_camera``, metres.
    """

    stamps_ns: IntArray
    poses: FloatArray

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> FloatArray:
        """Positions (N, 3) of the camera."""
        return self.poses[:, :3, 3]

    @property
    def span(self) -> str:
        """First and last stamp as text, in seconds."""
        return f"{self.stamps_ns[0] / NANOSECONDS:.3f} … {self.stamps_ns[-1] / NANOSECONDS:.3f} s"


def read_tum(path: Path) -> Trajectory:
    """Read a TUM file; stamps are converted from their decimal digits, so that no nanosecond is lost.

    Raises:
        InputError: no such file, not a TUM file (with the line number), stamps that do not increase, or no pose at all.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise InputError(f"trajectory '{path}' does not exist, expected a TUM file ('{_FIELDS}' a line)") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"trajectory '{path}' cannot be read as text ({error}), expected a TUM file") from error
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        stamp, values = _parse_line(path, number, line)
        if stamps and stamp <= stamps[-1]:
            raise InputError(
                f"'{path}' line {number}: stamp '{line.split()[0]}' does not increase, expected one pose a stamp, in order"
            )
        stamps.append(stamp)
        rows.append(values)
    if not rows:
        raise InputError(f"trajectory '{path}' holds no pose: tracking never started, or the file was cut")
    table = np.array(rows)
    return Trajectory(np.array(stamps, dtype=np.int64), pose(rotation_from_quaternion(table[:, 3:]), table[:, :3]))


def _parse_line(path: Path, number: int, line: str) -> tuple[int, list[float]]:
    """Return (stamp in ns, [x, y, z, qx, qy, qz, qw]) of one line, checked."""
    fields = line.split()
    try:
        stamp = int((Decimal(fields[0]) * NANOSECONDS).to_integral_value())
        values = [float(field) for field in fields[1:]]
    except (InvalidOperation, ValueError, OverflowError):
        values = []
    if len(values) != 7:
        raise InputError(f"'{path}' line {number}: '{line.strip()[:60]}' is not a TUM pose, expected '{_FIELDS}'")
    if not np.isfinite(values).all():
        raise InputError(f"'{path}' line {number}: '{line.strip()[:60]}' is not finite, expected '{_FIELDS}'")
    norm = float(np.linalg.norm(values[3:]))
    if abs(norm - 1.0) > _QUATERNION_TOLERANCE:
        raise InputError(f"'{path}' line {number}: quaternion has norm '{norm:.4g}', expected 1 (order '{_FIELDS}')")
    return stamp, values
