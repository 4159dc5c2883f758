"""Recordings made for a fault: any motion over any scene, small images, so that rendering takes seconds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from runs import Truth
from streams import Item, Stream, in_order

from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration, parse_calibration, to_yaml
from vli_common.geometry import inverse
from vli_common.types import EncodedImage
from vli_simulation.config import make_config
from vli_simulation.motion import Motion, Trajectory
from vli_simulation.simulate import Simulation

Move = Callable[[FloatArray, FloatArray], FloatArray]
"""Seconds since the first frame (N,) and the planned poses of the camera (N, 4, 4) → poses as they shall be."""


@dataclass(frozen=True)
class Recording:
    """A stream, its calibration and truth, and the triangles (F, 3, 3) of the surface."""

    stream: Stream
    calibration: Calibration
    truth: Truth
    triangles: FloatArray


class _Simulation(Simulation):
    """A simulation whose motion is changed before anything is rendered."""

    def __init__(self, scene: str, seed: int, parameters: dict[str, Any], move: Move) -> None:
        super().__init__(scene, make_config("smoke", parameters), seed)
        nodes = np.arange(-0.5, self.config.motion.duration_s + 0.5, 0.01)
        poses = move(nodes, self.motion.trajectory.camera_poses(nodes))
        T_cam_imu = self.rig.T_cam_imu
        self.motion = Motion(Trajectory(nodes, poses @ T_cam_imu, inverse(T_cam_imu)), self.motion.passes)
        times = self.offsets_ns * 1e-9
        self.poses = self.motion.trajectory.camera_poses(times)
        self._velocities, self._rates = self.motion.trajectory.camera_twists(times)


def simulate(scene: str, seed: int, parameters: dict[str, Any], move: Move = lambda times, poses: poses) -> Recording:
    """Return a recording with images of 320 × 240, where the parameters do not say otherwise."""
    simulation = _Simulation(scene, seed, {"rig.width": 320, "rig.height": 240, **parameters}, move)
    frames: list[Item] = [
        EncodedImage(frame.stamp_ns, bytes(frame.image.data), "jpeg", compressed=True) for frame in simulation.frames(2)
    ]
    poses = dict(zip(simulation.stamps_ns.tolist(), simulation.poses, strict=True))
    calibration = parse_calibration(to_yaml(simulation.rig.document))
    triangles = simulation.scene.mesh.vertices[simulation.scene.mesh.faces]
    return Recording(in_order([*frames, *simulation.imu()]), calibration, poses.__getitem__, triangles)
