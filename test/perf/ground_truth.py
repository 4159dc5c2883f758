"""What a benchmark knows of a recording that has a truth: poses, the surface, the motion of the IMU."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vli_bringup.tum import Trajectory, read_tum
from vli_common.arrays import BoolArray, FloatArray, IntArray
from vli_common.calibration import Calibration, load_calibration
from vli_common.geometry import inverse, transform
from vli_common.ply import read_mesh
from vli_common.types import NANOSECONDS
from vli_frontend.patch_alignment import MARGIN_PX, RADIUS
from vli_simulation import motion
from vli_simulation.caster import RayCaster
from vli_simulation.mesh import Mesh

GRAVITY = np.array([0.0, 0.0, 9.81])
_EDGE_SHARE = 0.02
"""A patch whose depth departs from a plane by more than this share lies across a depth edge."""
_HIDDEN_SHARE = 0.01


def load_surface(path: Path) -> RayCaster:
    """Return a surface to cast rays against; material and texture play no part."""
    mesh = read_mesh(path)
    none = np.zeros(len(mesh.faces), np.int64)
    return RayCaster(Mesh(mesh.vertices, mesh.faces, none, none, np.zeros((len(mesh.vertices), 2))))


@dataclass(frozen=True)
class Truth:
    """Poses of the camera, the surface, the camera model."""

    trajectory: Trajectory
    caster: RayCaster
    calibration: Calibration

    @staticmethod
    def load(recording: Path) -> Truth:
        """Return the truth of a directory that holds ``calibration.yaml``, ``truth.tum`` and ``surface.ply``."""
        return Truth(
            read_tum(recording / "truth.tum"),
            load_surface(recording / "surface.ply"),
            load_calibration(recording / "calibration.yaml"),
        )

    def pose(self, stamp_ns: int) -> FloatArray:
        """Return T_world_camera (4, 4) at the nearest stamp of the truth."""
        result: FloatArray = self.poses(np.array([stamp_ns]))[0]
        return result

    def poses(self, stamps_ns: IntArray) -> FloatArray:
        """Return T_world_camera (N, 4, 4) at the nearest stamps of the truth."""
        known = self.trajectory.stamps_ns
        after = np.clip(np.searchsorted(known, stamps_ns), 1, len(known) - 1)
        nearest = np.where(stamps_ns - known[after - 1] <= known[after] - stamps_ns, after - 1, after)
        result: FloatArray = self.trajectory.poses[nearest]
        return result

    def points(self, stamp_ns: int, rays: FloatArray) -> FloatArray:
        """Return the surface points (N, 3), world, that rays (N, 2) see; NaN where none."""
        depth = self.depth(stamp_ns, rays)
        return transform(self.pose(stamp_ns), depth[:, None] * np.column_stack([rays, np.ones(len(rays))]))

    def depth(self, stamp_ns: int, rays: FloatArray) -> FloatArray:
        """Return the depth (N,) of rays (N, 2); NaN where nothing is hit."""
        T = self.pose(stamp_ns)
        hits = self.caster.cast(T[:3, 3], np.column_stack([rays, np.ones(len(rays))]) @ T[:3, :3].T)
        return np.where(hits.triangle >= 0, hits.distance, np.nan).astype(np.float64)

    def rays(self, stamp_ns: int, points: FloatArray) -> FloatArray:
        """Return the rays (N, 2) along which points (N, 3), world, lie."""
        local = transform(inverse(self.pose(stamp_ns)), points)
        result: FloatArray = local[:, :2] / local[:, 2:]
        return result

    def pixels(self, stamp_ns: int, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return raw pixels (N, 2) of points (N, 3) and whether they are seen: inside the image by a margin, not hidden."""
        camera = self.calibration.camera
        local = transform(inverse(self.pose(stamp_ns)), points)
        pixels = camera.project(local)
        inside = ((pixels >= MARGIN_PX) & (pixels <= [camera.width - 1 - MARGIN_PX, camera.height - 1 - MARGIN_PX])).all(axis=1)
        depth = self.depth(stamp_ns, local[:, :2] / local[:, 2:])
        return pixels, inside & (np.abs(depth - local[:, 2]) < _HIDDEN_SHARE * local[:, 2])

    def on_edge(self, stamp_ns: int, pixels: FloatArray) -> BoolArray:
        """Return (N,) True where the depth within the patch is no plane."""
        v, u = (grid.ravel().astype(np.float64) for grid in np.mgrid[-RADIUS : RADIUS + 1 : 2, -RADIUS : RADIUS + 1 : 2])
        around = (pixels[:, None] + np.stack([u, v], axis=1)).reshape(-1, 2)
        inverse_depth = 1.0 / self.depth(stamp_ns, self.calibration.camera.unproject(around)).reshape(len(pixels), -1)
        design = np.stack([u, v, np.ones_like(u)], axis=1)
        fitted = np.nan_to_num(inverse_depth) @ np.linalg.pinv(design).T @ design.T
        residual = np.abs(fitted / inverse_depth - 1.0).max(axis=1)
        result: BoolArray = ~(residual < _EDGE_SHARE)
        return result


class TrueMotion:
    """The motion of ``imu_link``: quintic splines through the true poses.

    At 60 poses a second they follow a hand's tremor (12 Hz) to a per mille of its acceleration.

    Args:
        truth: poses, and the calibration for the place of the IMU.
    """

    def __init__(self, truth: Truth) -> None:
        T_cam_imu = truth.calibration.T_cam_imu
        if T_cam_imu is None:
            raise ValueError("the calibration has no 'T_cam_imu', needed for the motion of the IMU")
        stamps = truth.trajectory.stamps_ns
        self._first_ns, self._last_ns = int(stamps[0]), int(stamps[-1])
        self.timeshift_ns = truth.calibration.timeshift_ns
        """``t_imu = t_camera + timeshift``."""
        times = (stamps - self._first_ns) / NANOSECONDS
        self._trajectory = motion.Trajectory(times, truth.trajectory.poses @ T_cam_imu, inverse(T_cam_imu))

    def state(self, imu_stamps_ns: IntArray) -> motion.Kinematics:
        """Return the state at stamps (N,) of the IMU's clock; beyond the truth that at its ends."""
        camera_ns = np.clip(imu_stamps_ns - self.timeshift_ns, self._first_ns, self._last_ns)
        return self._trajectory.imu((camera_ns - self._first_ns) / NANOSECONDS)

    def imu(self, imu_stamps_ns: IntArray) -> FloatArray:
        """Return (N, 6): angular rate and specific force that an ideal IMU measures at stamps (N,) of its clock."""
        state = self.state(imu_stamps_ns)
        force = np.einsum("nji,nj->ni", state.T_world_imu[:, :3, :3], state.acceleration + GRAVITY)
        return np.concatenate([state.angular_velocity, force], axis=1)
