"""The unknowns of camera and IMU, and their names in the factor graph."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam

from vli_common.arrays import FloatArray

E, G, D, A = (gtsam.symbol(name, 0) for name in "egda")
"""T_cam_imu; R_world_board; time offset and gravity beyond those of the :class:`RigState` at hand."""


@dataclass(frozen=True)
class RigState:
    """What all frames share.

    Args:
        T_cam_imu: (4, 4).
        R_world_board: (3, 3).
        timeshift_s: t_imu = t_cam + timeshift.
        gravity: m/s².
    """

    T_cam_imu: FloatArray
    R_world_board: FloatArray
    timeshift_s: float
    gravity: float


@dataclass(frozen=True)
class FrameStates:
    """T_world_imu (F, 4, 4), velocity (F, 3) and biases (F, 6) accelerometer first, at the frames."""

    T_world_imu: FloatArray
    velocity: FloatArray
    biases: FloatArray


def x_key(index: int) -> int:
    """Return the key of T_world_imu at a frame."""
    return int(gtsam.symbol("x", index))


def v_key(index: int) -> int:
    """Return the key of the velocity at a frame."""
    return int(gtsam.symbol("v", index))


def b_key(index: int) -> int:
    """Return the key of the biases at a frame."""
    return int(gtsam.symbol("b", index))
