"""What a run leaves behind: trajectories, states and the counts of ``summary.json``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from vli_bringup.consistency import COVARIANCES, camera_covariance, covariance_text
from vli_bringup.pipeline import Event
from vli_bringup.stamps import seconds_text
from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration
from vli_common.geometry import inverse, quaternion_from_rotation
from vli_common.types import NANOSECONDS, BackEndOutput, FrameKind, TrackingState, WindowPoses


class Recorder:
    """Collects camera poses in ``map`` as they were published, and as they left the window.

    Args:
        calibration: for the pose of the camera in ``imu_link``; the two are one frame where there is no IMU.
    """

    def __init__(self, calibration: Calibration) -> None:
        T_cam_imu = calibration.T_cam_imu
        self._T_imu_camera = np.eye(4) if T_cam_imu is None else inverse(T_cam_imu)
        self._keyframes: set[int] = set()
        self.live: dict[int, FloatArray] = {}
        """Stamp of a long frame → T_map_camera (4, 4), as published."""
        self.final: dict[int, FloatArray] = {}
        """The same for frames that have left the window."""
        self.covariances: dict[int, FloatArray] = {}
        """Stamp → covariance (6, 6) of the live pose of the camera, order of ROS, axes of map; where it was given."""
        self.states: list[tuple[float, str, str]] = []
        """Stamp in seconds, state and reason, at each change of the state."""
        self._window: WindowPoses | None = None
        self._placed: list[int] = []
        self.reason = "no long frame reached the back end"
        """What the back end said last."""

    @property
    def keyframes(self) -> int:
        """Number of keyframes that entered a window."""
        return len(self._keyframes)

    def add(self, events: Iterable[Event]) -> None:
        """Take what a push of the pipeline brought."""
        for event in events:
            if isinstance(event, BackEndOutput):
                self._add_output(event)
            elif isinstance(event, WindowPoses):
                self._add_window(event)

    def write(self, directory: Path) -> None:
        """Write ``trajectory.tum`` and ``trajectory_final.tum``; ``covariance.csv`` where covariances were given."""
        final = {stamp: self.final[stamp] for stamp in self.live if stamp in self.final}
        (directory / "trajectory.tum").write_text(tum_text(self.live))
        (directory / "trajectory_final.tum").write_text(tum_text(final))
        if self.covariances:
            (directory / COVARIANCES).write_text(covariance_text(dict(sorted(self.covariances.items()))))

    def add_pose(self, stamp_ns: int, T_map_imu: FloatArray, covariance: FloatArray | None = None) -> None:
        """Take the pose of one long frame, as published, and its covariance (6, 6), where that is known."""
        self.live[stamp_ns] = T_map_imu @ self._T_imu_camera
        if covariance is not None:
            self.covariances[stamp_ns] = camera_covariance(covariance, T_map_imu, self._T_imu_camera)

    def add_state(self, stamp_ns: int, state: TrackingState, reason: str) -> None:
        """Take what the back end says of a frame; the states keep its changes only."""
        self.reason = reason
        if not self.states or state.value != self.states[-1][1]:
            self.states.append((stamp_ns / NANOSECONDS, state.value, reason))

    def _add_output(self, output: BackEndOutput) -> None:
        if output.pose is not None and output.state.has_pose:
            self.add_pose(output.stamp_ns, output.pose.T_map_imu, output.pose.covariance)
        self.add_state(output.stamp_ns, output.state, output.reason)

    def _add_window(self, window: WindowPoses) -> None:
        self._keyframes.update(window.stamps[window.kinds == FrameKind.KEYFRAME.value].tolist())
        if self._window is None or window.placement != self._window.placement or window.session != self._window.session:
            self._begin_placement(window)
        self._window = window
        leaving = window.final & (window.kinds != FrameKind.SHORT.value)
        self.final.update(zip(window.stamps[leaving].tolist(), window.T_map_camera[leaving], strict=True))
        self._placed += window.stamps[leaving].tolist()

    def _begin_placement(self, window: WindowPoses) -> None:
        """Move what has left the window since the last placement to where a relocalisation puts the window, as the map does."""
        old = self._window
        if old is not None and old.session == window.session:
            _, before, now = np.intersect1d(old.stamps[~old.final], window.stamps, return_indices=True)
            if len(now):
                T_map_session = window.T_map_camera[now[-1]] @ inverse(old.T_map_camera[~old.final][before[-1]])
                self.final.update((stamp, T_map_session @ self.final[stamp]) for stamp in self._placed)
        self._placed.clear()


def tum_text(poses: Mapping[int, FloatArray]) -> str:
    """Return poses ``T_map_camera`` (4, 4) by stamp (ns) as TUM text: seconds and metres, nine decimals."""
    if not poses:
        return ""
    stack = np.stack(list(poses.values()))
    values = np.concatenate([stack[:, :3, 3], quaternion_from_rotation(stack[:, :3, :3])], axis=1)
    lines = (
        f"{seconds_text(stamp)} {' '.join(f'{value:.9f}' for value in row)}\n" for stamp, row in zip(poses, values, strict=True)
    )
    return "".join(lines)
