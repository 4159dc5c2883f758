"""Is the reported covariance true? Its file, and the normalised estimation error squared (NEES) of the position.

Aligned by its first pose, which is the gauge, a trajectory of an ideal estimator has errors e with eᵀ P⁻¹ e of mean 3, the
dimension of the position (Bar-Shalom, Li & Kirubarajan, 2001): more is overconfident, less is too modest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vli_bringup.stamps import seconds_text
from vli_bringup.trajectory_metrics import Association
from vli_common.arrays import FloatArray, IntArray
from vli_common.errors import InputError
from vli_common.geometry import inverse, skew
from vli_common.types import NANOSECONDS

COVARIANCES = "covariance.csv"
_AXES = ("x", "y", "z", "rx", "ry", "rz")
_ROWS, _COLUMNS = np.triu_indices(6)
HEADER = ",".join(["stamp", *(f"{_AXES[i]}_{_AXES[j]}" for i, j in zip(_ROWS, _COLUMNS, strict=True))])


@dataclass(frozen=True, slots=True)
class ConsistencyFigures:
    """The reported covariance against the errors; the field names are the keys of the JSON report, None without covariances.

    Args:
        position_nees: mean over the poses after the first; 3 is consistent.
        position_sigma_mm: reported, of the last pose: the root of the sum over the axes.
    """

    position_nees: float | None = None
    position_sigma_mm: float | None = None


def camera_covariance(covariance: FloatArray, T_map_imu: FloatArray, T_imu_camera: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of the camera's pose from that of ``T_map_imu`` (4, 4); both in ROS's order, axes of map."""
    lever = T_map_imu[:3, :3] @ T_imu_camera[:3, 3]
    jacobian = np.eye(6)
    jacobian[:3, 3:] = -skew(lever)
    result: FloatArray = jacobian @ covariance @ jacobian.T
    return result


def covariance_text(covariances: Mapping[int, FloatArray]) -> str:
    """Return covariances (6, 6) by stamp (ns) as CSV: the upper triangle, row by row, metres and radians."""
    rows = (
        ",".join([seconds_text(stamp), *(f"{value:.9e}" for value in covariance[_ROWS, _COLUMNS])])
        for stamp, covariance in covariances.items()
    )
    return "\n".join([HEADER, *rows]) + "\n"


def read_covariances(path: Path) -> tuple[IntArray, FloatArray]:
    """Read stamps (N,) ns and covariances (N, 6, 6) of a ``covariance.csv``.

    Raises:
        InputError: not such a file.
    """
    try:
        header, *lines = path.read_text(encoding="utf-8").splitlines() or [""]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"covariances '{path}' cannot be read as text ({error}), expected '{HEADER[:24]}…'") from error
    if header != HEADER:
        raise InputError(f"covariances '{path}' begin with '{header[:40]}', expected '{HEADER[:24]}…'")
    stamps, values = np.empty(len(lines), np.int64), np.empty((len(lines), 6, 6))
    for row, line in enumerate(lines):
        stamp, *entries = line.split(",")
        try:
            seconds, fraction = stamp.split(".")
            stamps[row] = int(seconds) * NANOSECONDS + int(fraction.ljust(9, "0"))
            triangle = np.array([float(entry) for entry in entries]).reshape(len(_ROWS))
            values[row][_ROWS, _COLUMNS] = values[row][_COLUMNS, _ROWS] = triangle
        except ValueError as error:
            raise InputError(f"'{path}' line {row + 2}: '{line[:40]}' is no covariance ({error}), expected 22 numbers") from error
    return stamps, values


def position_nees(pairs: Association, covariances: FloatArray) -> FloatArray:
    """Return eᵀ P⁻¹ e (N − 1,) of the positions after the first, the first pose aligned with the truth.

    Args:
        pairs: N ≥ 2 poses and their truth.
        covariances: (N, 6, 6) of the poses, in the order of ROS, axes of map.
    """
    T_truth_map = pairs.truth[0] @ inverse(pairs.estimate[0])
    error = (T_truth_map @ pairs.estimate - pairs.truth)[1:, :3, 3]
    rotation = T_truth_map[:3, :3]
    covariance = rotation @ covariances[1:, :3, :3] @ rotation.T
    result: FloatArray = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    return result


def consistency_figures(pairs: Association, stamps_ns: IntArray, covariances: FloatArray) -> ConsistencyFigures:
    """Return the figures of a trajectory from the covariances (M, 6, 6) at stamps (M,).

    Raises:
        InputError: a pose has no covariance, or one that no distribution has.
    """
    index = np.searchsorted(stamps_ns, pairs.stamps_ns)
    known = stamps_ns[np.minimum(index, len(stamps_ns) - 1)] == pairs.stamps_ns if len(stamps_ns) else np.zeros(1, np.bool_)
    if not known.all():
        raise InputError(f"'{(~known).sum()}' poses have no covariance in '{COVARIANCES}', expected those of the same run")
    matched = covariances[index]
    if not np.isfinite(matched).all() or (np.linalg.eigvalsh(matched[:, :3, :3])[:, 0] <= 0).any():
        raise InputError(f"'{COVARIANCES}' has matrices that are not positive definite, expected covariances")
    sigma_m = float(np.sqrt(np.trace(matched[-1, :3, :3])))
    return ConsistencyFigures(float(position_nees(pairs, matched).mean()), 1e3 * sigma_m)
