"""Where the window's world is in the map: one and the same, until a relocalisation says otherwise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, transform
from vli_common.types import MapConstraints, PoseEstimate, WindowPoses


class Placement:
    """Moves what leaves the back end into the map, and what comes from the map into the window's world.

    The window itself is left where it is: its prior and its gravity stay valid whatever the relocalisation says.
    """

    def __init__(self) -> None:
        self._T_map_world = np.eye(4)
        self._sigma_m = 0.0
        self.is_located = True
        """False where the place in the map is a guess."""
        self.number = 0
        """Counts the places that the window had: what is published changes with it by a motion that nobody knows beforehand."""

    @property
    def hint(self) -> str:
        """What to do about a guessed place, in words; empty where it is known."""
        if self.is_located:
            return ""
        return (
            f"the place in the map is a guess since the loss, to {1e3 * self._sigma_m:.0f} mm: go back to a part that is mapped"
        )

    def guess(self, sigma_m: float) -> None:
        """Take how uncertain the place of a new window is, metres; zero where the map begins."""
        if sigma_m > 0.0:
            self.is_located = False
            self.number += 1
        self._sigma_m = float(np.hypot(self._sigma_m, sigma_m))

    def relocalise(self, T_map_session: FloatArray, sigma_m: float) -> None:
        """Take where what was published as ``map`` so far is in the map (4, 4), and how surely, metres."""
        self._T_map_world = T_map_session @ self._T_map_world
        self._sigma_m, self.is_located = sigma_m, True
        self.number += 1

    def of_pose(self, pose: PoseEstimate) -> PoseEstimate:
        """Return a live pose in the map; the uncertainty of the place comes on top of its own."""
        if self._is_identity:
            return pose
        turn = np.kron(np.eye(2), self._T_map_world[:3, :3])
        covariance = turn @ pose.covariance @ turn.T
        covariance[:3, :3] += self._sigma_m**2 * np.eye(3)
        return replace(
            pose,
            T_map_imu=self._T_map_world @ pose.T_map_imu,
            T_map_odom=self._T_map_world @ pose.T_map_odom,
            velocity=self._T_map_world[:3, :3] @ pose.velocity,
            covariance=covariance,
        )

    def of_window(self, window: WindowPoses) -> WindowPoses:
        """Return the poses of a window in the map, and whether that is known."""
        if self.number == 0:
            return window
        T_map_camera = self._T_map_world @ window.T_map_camera
        return replace(window, T_map_camera=T_map_camera, located=self.is_located, placement=self.number)

    def to_window(self, constraints: MapConstraints) -> MapConstraints:
        """Return map constraints, eq. (4), in the window's world."""
        if self._is_identity:
            return constraints
        back = inverse(self._T_map_world)
        normals = constraints.normals_map @ back[:3, :3].T
        return replace(constraints, points_map=transform(back, constraints.points_map), normals_map=normals)

    @property
    def _is_identity(self) -> bool:
        return self._sigma_m == 0.0 and np.array_equal(self._T_map_world, np.eye(4))
