"""Trajectories that the tests of the evaluation share."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vli_bringup.stamps import seconds_text
from vli_bringup.tum import Trajectory
from vli_common.arrays import FloatArray, IntArray
from vli_common.geometry import pose, quaternion_from_rotation, so3_exp

START_NS = 1_700_000_000_123_456_789
FRAME_NS = 16_666_667


def wavy(count: int = 400, frame_ns: int = FRAME_NS) -> Trajectory:
    """Return a scan of 0.2 m with a camera that sways and turns: truth at the rate of all frames."""
    t = np.linspace(0, 1, count)
    positions = np.stack([0.2 * t, 0.01 * np.sin(9 * t), 0.03 + 0.004 * np.cos(14 * t)], axis=1)
    rotations = so3_exp(np.stack([np.pi + 0.1 * np.sin(5 * t), 0.2 * np.cos(7 * t), 0.3 * t], axis=1))
    return Trajectory(START_NS + frame_ns * np.arange(count), pose(rotations, positions))


def disturbed(trajectory: Trajectory, seed: int, translation_m: float = 1e-3, rotation_rad: float = 0.02) -> Trajectory:
    """Return a trajectory with a random walk on translation and rotation."""
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(size=(len(trajectory), 6)), axis=0) / np.sqrt(len(trajectory))
    wrong = pose(so3_exp(rotation_rad * walk[:, :3]), translation_m * walk[:, 3:])
    return Trajectory(trajectory.stamps_ns, trajectory.poses @ wrong)


def moved(trajectory: Trajectory, T: FloatArray, scale: float = 1.0) -> Trajectory:
    """Return the trajectory in another frame (4, 4), and enlarged."""
    poses = trajectory.poses.copy()
    poses[:, :3, 3] *= scale
    return Trajectory(trajectory.stamps_ns, T @ poses)


def part(trajectory: Trajectory, which: slice | IntArray) -> Trajectory:
    """Return some of the poses."""
    return Trajectory(trajectory.stamps_ns[which], trajectory.poses[which])


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write nine decimals of stamps, and all digits of the poses."""
    rows = np.concatenate([trajectory.positions, quaternion_from_rotation(trajectory.poses[:, :3, :3])], axis=1)
    lines = [
        f"{seconds_text(int(s))} {' '.join(map(repr, map(float, row)))}"
        for s, row in zip(trajectory.stamps_ns, rows, strict=True)
    ]
    path.write_text("# stamp x y z qx qy qz qw\n" + "\n".join(lines) + "\n")
