"""Long images, IMU and laser points in; tracks and preintegration out."""

from __future__ import annotations

from dataclasses import dataclass, replace

from nav_msgs.msg import Odometry
from sensor_msgs.msg import Image as ImageMessage
from sensor_msgs.msg import PointCloud2

from vli_common.calibration import Calibration
from vli_common.config import parameter
from vli_common.errors import MessageError
from vli_common.messages import (
    Session,
    bias_from_message,
    image_from_message,
    imu_from_message,
    no_preintegration_message,
    odometry_from_message,
    preintegration_to_message,
    scan_from_message,
    tracks_to_message,
)
from vli_common.node import VliNode, run_node
from vli_common.status import Health
from vli_common.topics import BIAS, IMAGE_LONG, IMU, LASER_POINTS, ODOMETRY, PREINTEGRATION, TRACKS
from vli_common.types import Counters, FrontEndOutput, Image, ImuBias, ImuSample, LaserScan, PoseEstimate
from vli_frontend.config import FrontEndConfig
from vli_frontend.frontend import FrontEnd
from vli_frontend.warm_up import warm_up

_IDS = 1 << 31
"""Half of what the message holds: a session has the other half to count on."""
_ID_PERIOD_NS = 1_000_000
"""A thousand ids a second go by between two starts, some twenty times what a front end uses."""


@dataclass(frozen=True)
class InputTopics:
    """Where the IMU is."""

    imu_topic: str = parameter(IMU.name, doc="sensor_msgs/Imu, angular rate in rad/s, specific force in m/s²")


class FrontEndNode(VliNode):
    """Tracks, keyframes, preintegration."""

    def __init__(self) -> None:
        super().__init__("frontend_node", {FrontEndConfig: "", InputTopics: ""}, fixed=[InputTopics])
        self._front_end: FrontEnd | None = None
        for topic in (TRACKS, PREINTEGRATION):
            self.advertise(topic)
        uses_imu = self.mode.uses_imu
        self.receive(IMU, imu_from_message, self._on_imu, self.parameters.config(InputTopics).imu_topic, uses_imu, uses_imu)
        self.receive(LASER_POINTS, scan_from_message, self._on_scan)
        self.receive(IMAGE_LONG, self._read_image, self._on_image, sheds=1)
        self.receive(BIAS, lambda message: bias_from_message(message, self.session), self._on_bias, ends=False)
        self.receive(ODOMETRY, self._to_pose, self._on_pose, ends=False)

    def create_stage(self, calibration: Calibration | None) -> None:
        """Make the front end."""
        if calibration is not None:
            warm_up()
            # Ids of a front end that is started anew must not meet those of the one before, in the back end's window.
            first_id = self.started_ns // _ID_PERIOD_NS % _IDS
            self._front_end = FrontEnd(calibration, self.parameters.config(FrontEndConfig), self.mode, first_id)

    def drop_stage(self) -> None:
        """Let go of the front end."""
        self._front_end = None

    def on_session(self, session: Session) -> None:
        """Begin a session."""
        self.front_end.reset(session.number)

    def stage_counters(self) -> Counters:
        """Return the counters of the front end."""
        return self._front_end.counters if self._front_end else Counters()

    def stage_status(self) -> tuple[Health, str, dict[str, str]]:
        """Return a warning where the calibration's time shift is wrong."""
        if self._front_end is None:
            return Health.OK, "", {}
        hint = self._front_end.hint
        return Health.WARN if hint else Health.OK, hint, {"timeshift_ns": str(self._front_end.timeshift_ns)}

    @property
    def front_end(self) -> FrontEnd:
        """The front end, which is there once the node is ready."""
        return self.existing(self._front_end)

    def _on_imu(self, sample: ImuSample) -> None:
        self._emit(self.front_end.add_imu(sample))

    def _read_image(self, message: ImageMessage) -> Image:
        return image_from_message(message, self.session, self.existing(self.calibration).camera)

    def _on_image(self, image: Image) -> None:
        self._emit(self.front_end.add_image(image))

    def _on_scan(self, scan: LaserScan) -> None:
        self.front_end.add_scan(scan)

    def _on_bias(self, bias: ImuBias) -> None:
        self.front_end.set_bias(bias)

    def _to_pose(self, message: Odometry) -> PoseEstimate:
        return replace(odometry_from_message(message), session=self.session)

    def _on_pose(self, pose: PoseEstimate) -> None:
        self.front_end.add_pose(pose)

    def _emit(self, frames: list[FrontEndOutput]) -> None:
        for frame in frames:
            self.send(PREINTEGRATION, self._inertial_message(frame))
            self.send(TRACKS, tracks_to_message(frame.tracks))

    def _inertial_message(self, frame: FrontEndOutput) -> PointCloud2:
        """Return the preintegration, or the note that there is none: samples beyond all measure lead to one nobody would take."""
        tracks, inertial = frame.tracks, frame.preintegration
        if inertial is not None:
            try:
                return preintegration_to_message(inertial)
            except MessageError as error:
                self.counters.add("preintegrations_unsound")
                self.get_logger().warning(f"the IMU is left out: {error}", throttle_duration_sec=5.0)
        return no_preintegration_message(tracks.stamp_ns, tracks.session)


def main() -> None:
    """Run the node."""
    run_node(FrontEndNode)


if __name__ == "__main__":
    main()
