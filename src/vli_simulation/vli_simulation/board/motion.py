"""The moving sensor before a board that stands still: turned and moved about all six axes, the board kept in view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vli_calibration.targets import Target
from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, pose, so3_exp
from vli_simulation.board.config import BoardSimulationConfig
from vli_simulation.motion import MARGIN_S, NODE_S, RAMP_S, Trajectory, hand_tremor, oscillation, smooth_step
from vli_simulation.rig import Rig

_BAND_HZ = (0.2, 1.0)
_COMPONENTS = 5
_TURN_RAD = np.deg2rad([10.0, 10.0, 18.0])
"""Standard deviation of tilt, tilt and roll."""
_WANDER = np.array([0.10, 0.10, 0.11])
"""Of the distance: aside, aside, and towards the board."""
_BOARD_TILT_RAD = np.deg2rad(15.0)


@dataclass(frozen=True)
class BoardMotion:
    """A trajectory in the gravity-aligned world, and where the board is in it."""

    trajectory: Trajectory
    T_world_board: FloatArray


def plan_board_motion(config: BoardSimulationConfig, target: Target, rig: Rig, distance: float, seed: int) -> BoardMotion:
    """Return a motion that excites all six axes, at rest for ``motion.rest_s`` first.

    Args:
        config: of the recording.
        target: the board; it lies on a table, not quite level.
        rig: the instrument.
        distance: mean distance of camera and board, metres.
        seed: of the motion.
    """
    rng = np.random.default_rng([seed, 21])
    times = np.arange(-MARGIN_S, config.motion.duration_s + MARGIN_S + NODE_S, NODE_S)
    rest = config.motion.rest_s
    envelope = (smooth_step((times - rest) / RAMP_S) if rest > 0 else np.ones_like(times))[:, None]
    # The hand moves rarely beyond two standard deviations: it sees the board.
    swing = 2.2 * np.tanh(config.board.excitation * oscillation(rng, times, _BAND_HZ, _COMPONENTS) / 2.2)
    shake, shake_turn = hand_tremor(rng, times, config.motion.tremor)
    start = so3_exp(np.array([0.0, 0.0, rng.uniform(-0.3, 0.3)]))
    rotation = start @ so3_exp(envelope * (swing[:, :3] * _TURN_RAD + shake_turn))
    x0, y0, x1, y1 = target.extent
    middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.0])
    from_board = np.array([0.0, 0.0, -distance]) + envelope * (distance * swing[:, 3:] * _WANDER + shake)
    # In its own frame, the camera moves about the board: tilting it does not lose the board from sight.
    T_board_cam = pose(rotation, middle + np.einsum("nij,nj->ni", rotation, from_board))
    tilt = so3_exp(rng.normal(0, 0.5, 3) * _BOARD_TILT_RAD)
    T_world_board = pose(tilt @ np.diag([1.0, -1.0, -1.0]), np.array([0.2, 0.1, 0.75]))
    return BoardMotion(Trajectory(times, T_world_board @ T_board_cam @ rig.T_cam_imu, inverse(rig.T_cam_imu)), T_world_board)
