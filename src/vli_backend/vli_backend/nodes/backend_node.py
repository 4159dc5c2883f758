"""Tracks, preintegration, laser points and map constraints in; poses and windows out."""

from __future__ import annotations

from collections import deque
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped

from vli_backend.backend import BackEnd
from vli_backend.config import BackEndConfig
from vli_backend.warm_up import warm_up
from vli_common.calibration import Calibration
from vli_common.frame_pairing import FramePairing, NoPreintegration
from vli_common.geometry import inverse
from vli_common.messages import (
    Session,
    bias_to_message,
    constraints_from_message,
    odometry_to_message,
    path_to_message,
    pose_to_message,
    pose_transforms,
    preintegration_from_message,
    relocalisation_from_message,
    scan_from_message,
    tracks_from_message,
    transform_to_message,
    window_to_message,
)
from vli_common.node import VliNode, run_node
from vli_common.status import Health
from vli_common.topics import (
    BIAS,
    CAMERA_FRAME,
    IMU_FRAME,
    LASER_POINTS,
    MAP_CONSTRAINTS,
    ODOMETRY,
    PATH,
    POSE,
    PREINTEGRATION,
    RELOCALISATION,
    TF,
    TF_STATIC,
    TRACKS,
    WINDOW,
)
from vli_common.types import (
    BackEndOutput,
    Counters,
    FrontEndOutput,
    LaserScan,
    MapConstraints,
    PoseEstimate,
    Preintegration,
    Relocalisation,
    TrackingState,
    Tracks,
    WindowPoses,
)

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # The pip wheels of ROS have no tf2_msgs; odometry and pose say the same.
    TFMessage = None

_PATH_POSES = 5000
_PATH_EVERY = 15
"""Poses between two messages of the path, which repeats all of it."""
_HEALTH = {
    TrackingState.INITIALISING: Health.OK,
    TrackingState.TRACKING: Health.OK,
    TrackingState.DEGRADED: Health.WARN,
    TrackingState.LOST: Health.ERROR,
}


class BackEndNode(VliNode):
    """A pose for every long frame, a window for every keyframe."""

    def __init__(self) -> None:
        super().__init__("backend_node", {BackEndConfig: ""})
        self._back_end: BackEnd | None = None
        self._pairing = FramePairing()
        self._path: deque[Any] = deque(maxlen=_PATH_POSES)
        self._poses = 0
        self._last = BackEndOutput(0, TrackingState.INITIALISING, "waiting for the first frame")
        for topic in (ODOMETRY, POSE, PATH, WINDOW, BIAS, *((TF, TF_STATIC) if TFMessage else ())):
            self.advertise(topic)
        self.receive(LASER_POINTS, scan_from_message, self._on_scan, sheds=1)
        self.receive(PREINTEGRATION, preintegration_from_message, self._on_preintegration)
        self.receive(TRACKS, tracks_from_message, self._on_tracks)
        self.receive(MAP_CONSTRAINTS, constraints_from_message, self._on_constraints, ends=False, required=self.mode.uses_map)
        self.receive(RELOCALISATION, self._read_relocalisation, self._on_relocalisation, ends=False, required=False)

    def create_stage(self, calibration: Calibration | None) -> None:
        """Make the back end, and say where the camera is on the IMU."""
        if calibration is None:
            return
        warm_up()
        self._back_end = BackEnd(calibration, self.parameters.config(BackEndConfig), self.mode)
        if TFMessage and calibration.T_cam_imu is not None:
            T_imu_camera = inverse(calibration.T_cam_imu)
            self.send(TF_STATIC, TFMessage(transforms=[transform_to_message(0, IMU_FRAME, CAMERA_FRAME, T_imu_camera)]))

    def drop_stage(self) -> None:
        """Let go of the back end."""
        self._back_end = None

    def on_session(self, session: Session) -> None:
        """Hand over what the old session has left, then begin the new one."""
        self._send_window(self.back_end.flush())
        self._pairing.clear()
        self._path.clear()
        self.back_end.reset(session.number, session.reason)

    def on_pause(self) -> None:
        """Hand over the window."""
        self.on_finish()

    def on_finish(self) -> None:
        """Hand over everything still in the window as final."""
        self._feed(self._pairing.flush())
        self._send_window(self.back_end.flush())

    def stage_counters(self) -> Counters:
        """Return the counters of pairing and back end."""
        stage = self._back_end.counters.values if self._back_end else {}
        return Counters({**self._pairing.counters.values, **stage})

    def stage_status(self) -> tuple[Health, str, dict[str, str]]:
        """Return the tracking state, since which frame, and why."""
        last = self._last
        values = {"tracking": last.state.value, "reason": last.reason, "stamp_ns": str(last.stamp_ns)}
        skipped = self.counters["frames_skipped"]
        hint = f"too slow: {skipped} frames between keyframes have no pose" if skipped else ""
        health = Health.WARN if hint and last.state is TrackingState.TRACKING else _HEALTH[last.state]
        return health, last.reason or hint, values

    @property
    def back_end(self) -> BackEnd:
        """The back end, which is there once the node is ready."""
        return self.existing(self._back_end)

    def _on_scan(self, scan: LaserScan) -> None:
        self._feed(self._pairing.add_scan(scan))

    def _on_constraints(self, constraints: MapConstraints) -> None:
        self.back_end.add_constraints(constraints)

    def _read_relocalisation(self, message: PoseWithCovarianceStamped) -> Relocalisation:
        return relocalisation_from_message(message, self.session)

    def _on_relocalisation(self, found: Relocalisation) -> None:
        self.back_end.relocalise(found)

    def _on_preintegration(self, preintegration: Preintegration | NoPreintegration) -> None:
        self._feed(self._pairing.add_preintegration(preintegration))

    def _on_tracks(self, tracks: Tracks) -> None:
        self._feed(self._pairing.add_tracks(tracks))

    def _feed(self, items: list[LaserScan | FrontEndOutput]) -> None:
        for item in items:
            if isinstance(item, LaserScan):
                self.back_end.add_scan(item)
            elif self.is_behind and not item.tracks.keyframe and self._last.state is TrackingState.TRACKING:
                # The window consists of keyframes, and the IMU of the frames after reaches back to one.
                self.counters.add("frames_skipped")
            else:
                self._publish(self.back_end.add_frame(item))

    def _publish(self, output: BackEndOutput) -> None:
        if output.pose is not None and output.state.has_pose:
            self._send_pose(output.pose)
        self._send_window(output.window)
        if output.bias is not None:
            self.send(BIAS, bias_to_message(output.bias))
        self._note(output)

    def _note(self, output: BackEndOutput) -> None:
        """Tell a change of the tracking state at once."""
        changed = output.state is not self._last.state
        self._last = output
        if changed:
            self.publish_status()

    def _send_pose(self, pose: PoseEstimate) -> None:
        self.send(ODOMETRY, odometry_to_message(pose))
        message = pose_to_message(pose)
        self.send(POSE, message)
        if TFMessage:
            self.send(TF, TFMessage(transforms=pose_transforms(pose)))
        self._path.append(message)
        self._poses += 1
        if self._poses % _PATH_EVERY == 0 and self.has_listener(PATH):
            self.send(PATH, path_to_message(list(self._path)))

    def _send_window(self, window: WindowPoses | None) -> None:
        if window is not None:
            self.send(WINDOW, window_to_message(window))


def main() -> None:
    """Run the node."""
    run_node(BackEndNode)


if __name__ == "__main__":
    main()
