"""A stream through the offline pipeline, and what came out of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import groupby

import numpy as np
from scipy.spatial import KDTree
from streams import Stream

from vli_bringup.pipeline import Event, Pipeline, Stages
from vli_bringup.settings import Settings
from vli_bringup.tum import Trajectory
from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration
from vli_common.geometry import align, inverse, transform
from vli_common.types import NANOSECONDS, BackEndOutput, Mode, TrackingState, WindowPoses

Truth = Callable[[int], FloatArray]
"""Stamp → true pose of the camera (4, 4)."""


@dataclass
class Run:
    """What the stages said of a stream, and the map they made.

    Args:
        calibration: of the recording.
        pipeline: with its stages, as the run left them.
        outputs: of the back end, one a long frame.
        windows: as they went to the mapper.
    """

    calibration: Calibration
    pipeline: Pipeline
    outputs: list[BackEndOutput] = field(default_factory=list)
    windows: list[WindowPoses] = field(default_factory=list)

    def add(self, events: list[Event]) -> None:
        self.outputs += [event for event in events if isinstance(event, BackEndOutput)]
        self.windows += [event for event in events if isinstance(event, WindowPoses)]

    @property
    def states(self) -> list[TrackingState]:
        """The states one after another, each once."""
        return [state for state, _ in groupby(output.state for output in self.outputs)]

    @property
    def reasons(self) -> list[str]:
        return [output.reason for output in self.outputs]

    @cached_property
    def counters(self) -> Mapping[str, int]:
        """Counters of all stages; of equal names the sum."""
        stages = self.pipeline.stages
        owners = (self.pipeline, stages.demultiplexer, stages.scanner, stages.front_end, stages.back_end, stages.mapper)
        total: dict[str, int] = {}
        for owner in owners:
            for name, count in owner.counters.values.items() if owner is not None else ():
                total[name] = total.get(name, 0) + count
        return total

    def count(self, name: str) -> int:
        return self.counters.get(name, 0)

    def time_s(self, output: BackEndOutput) -> float:
        return (output.stamp_ns - self.outputs[0].stamp_ns) / NANOSECONDS

    def within(self, begin_s: float, end_s: float = 1e9) -> list[BackEndOutput]:
        """Outputs of the long frames in [begin, end) seconds since the first one."""
        return [output for output in self.outputs if begin_s <= self.time_s(output) < end_s]

    def live(self, begin_s: float = 0.0, end_s: float = 1e9, state: TrackingState | None = None) -> Trajectory:
        """Poses of the camera as published, in one state or in any that has a pose."""
        T_imu_cam = inverse(self.calibration.T_cam_imu) if self.calibration.T_cam_imu is not None else np.eye(4)
        found = [
            (output.stamp_ns, output.pose.T_map_imu @ T_imu_cam)
            for output in self.within(begin_s, end_s)
            if output.pose is not None and output.state.has_pose and state in (None, output.state)
        ]
        return Trajectory(np.array([stamp for stamp, _ in found], np.int64), np.array([T for _, T in found]).reshape(-1, 4, 4))

    def is_finite(self) -> bool:
        """Whether nothing that left the pipeline holds a NaN or an infinity."""
        poses = [output.pose for output in self.outputs if output.pose is not None]
        arrays = [array for pose in poses for array in (pose.T_map_imu, pose.T_map_odom, pose.velocity, pose.covariance)]
        arrays += [window.T_map_camera for window in self.windows]
        return all(bool(np.isfinite(array).all()) for array in (*arrays, self.pipeline.stages.mapper.cloud().points))


def run(stream: Stream, calibration: Calibration, mode: Mode = Mode.VLI_SLAM, settings: Settings | None = None) -> Run:
    """Push a stream through fresh stages to its end."""
    pipeline = Pipeline(Stages.create(calibration, settings or Settings(), mode), mode)
    result = Run(calibration, pipeline)
    for item in stream:
        result.add(pipeline.push(item))
    result.add(pipeline.flush())
    return result


def rmse_mm(trajectory: Trajectory, truth: Truth) -> float:
    """Root mean square of the position error after SE(3) alignment, millimetres."""
    true = np.stack([truth(int(stamp)) for stamp in trajectory.stamps_ns])
    T_truth_map, _ = align(trajectory.positions, true[:, :3, 3])
    error = transform(T_truth_map, trajectory.positions) - true[:, :3, 3]
    return 1e3 * float(np.sqrt((error**2).sum(axis=1).mean()))


def map_in_truth(trajectory: Trajectory, truth: Truth, lever_m: float = 0.03) -> FloatArray:
    """Pose (4, 4) of the map in the truth, from centre and axes of every pose."""
    corners = np.concatenate([np.zeros((1, 3)), lever_m * np.eye(3)])
    true = np.concatenate([transform(truth(int(stamp)), corners) for stamp in trajectory.stamps_ns])
    return align(np.concatenate([transform(T, corners) for T in trajectory.poses]), true)[0]


class Surface:
    """What the laser saw in truth, as planes through the nearest seen points.

    Args:
        seen: (S, 3), some 0.25 mm apart.
    """

    def __init__(self, seen: FloatArray) -> None:
        self._seen, self._tree = seen, KDTree(seen)

    def distances_mm(self, points: FloatArray) -> FloatArray:
        """Return the distance (N,) of each point to the plane through its six nearest seen points, millimetres."""
        _, near = self._tree.query(points, k=6, workers=2)
        patch = self._seen[near]
        centre = patch.mean(axis=1, keepdims=True)
        normals = np.linalg.svd(patch - centre)[2][:, 2]
        result: FloatArray = 1e3 * np.abs(np.einsum("ni,ni->n", points - centre[:, 0], normals))
        return result

    def beyond(self, points: FloatArray, limit_mm: float) -> float:
        """Return the share of the points that are farther than that from everything seen."""
        return float((1e3 * self._tree.query(points, workers=2)[0] > limit_mm).mean())
