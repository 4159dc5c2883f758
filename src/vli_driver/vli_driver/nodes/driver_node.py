"""Plays a bag as if it were the scanner: camera, IMU, calibration, session."""

from __future__ import annotations

import threading
import time
from pathlib import Path

from std_msgs.msg import String

from vli_common.calibration import Calibration, to_yaml
from vli_common.messages import encoded_to_cdr, exposure_to_message, imu_to_cdr
from vli_common.node import VliNode, run_node
from vli_common.status import Health, NodeState
from vli_common.topics import CALIBRATION, EXPOSURE, IMAGE_RAW, IMAGE_RAW_COMPRESSED, IMU
from vli_common.types import Counters, EncodedImage, ImuSample
from vli_driver.bag import BagReader, BagTopics
from vli_driver.config import DriverConfig
from vli_driver.player import BagPlayer, PlaybackConfig

_POLL_S = 0.02
_JOIN_S = 1.0
"""A playback that was stopped ends after the item that it reads or publishes."""
_SETTLE_S = 0.3
"""A writer may know its reader a moment later than the reader knows its writer."""
_DRAIN_S = 5.0
"""Between loops the other nodes get so long to work off what they hold."""


class DriverNode(VliNode):
    """Waits until the nodes of ``wait_for`` are ready and of the new session, then plays.

    Raises:
        InputError: the bag cannot be used.
    """

    def __init__(self) -> None:
        super().__init__("driver_node", {DriverConfig: "", PlaybackConfig: ""}, needs_calibration=False, fixed=[PlaybackConfig])
        self._playback = self.parameters.config(PlaybackConfig)
        self._player = self._make_player()
        self._thread: threading.Thread | None = None
        self._bag_warnings = ""
        for topic in (CALIBRATION, IMAGE_RAW, IMAGE_RAW_COMPRESSED, EXPOSURE, IMU):
            self.advertise(topic)

    def check(self) -> None:
        """Open the bag, to see whether that can be done."""
        self._open_reader()

    def create_stage(self, calibration: Calibration | None) -> None:
        """Publish the calibration."""
        if calibration is not None:
            self.send(CALIBRATION, String(data=to_yaml(calibration.document)))

    def drop_stage(self) -> None:
        """Stop the playback; the next one begins at the beginning."""
        self._stop_playing()
        self._player, self._thread = self._make_player(), None

    def on_pause(self) -> None:
        """Hold the playback."""
        self._player.pause()

    def on_resume(self) -> None:
        """Start to play, or go on."""
        self._player.resume()
        if self._playback.bag and self._thread is None:
            self._thread = threading.Thread(target=self._play, name="player", daemon=True)
            self._thread.start()

    def stage_counters(self) -> Counters:
        """Return the counters of the playback."""
        return self._player.counters

    def stage_status(self) -> tuple[Health, str, dict[str, str]]:
        """Return the position in the bag, and which stamp was due when."""
        late = self._player.counters["late"]
        hint = f"{late} items were late: the machine does not keep the pace of the bag" if late else ""
        values = {"position_ns": str(self._player.position_ns)}
        if self._bag_warnings:
            values["bag_warnings"] = self._bag_warnings
        if self._player.due is not None:
            values |= dict(zip(("due_stamp_ns", "due_wall_ns"), map(str, self._player.due), strict=True))
        return Health.WARN if late else Health.OK, hint, values

    def close(self) -> bool:
        """Stop the playback, then the node."""
        self._stop_playing()
        return super().close()

    def _stop_playing(self) -> None:
        self._player.stop()
        if self._thread is not None:
            self._thread.join(_JOIN_S)

    def _make_player(self) -> BagPlayer:
        return BagPlayer(self._playback.rate, self._publish_item, self._on_jump)

    def _open_reader(self) -> BagReader | None:
        if not self._playback.bag:
            return None
        config, playback = self.parameters.config(DriverConfig), self._playback
        topics = BagTopics(
            config.image_topic, config.imu_topic, config.camera_info_topic, config.exposure_topic, self.mode.uses_imu
        )
        return BagReader(Path(playback.bag), topics, playback.start, playback.duration or None)

    def _play(self) -> None:
        try:
            self._play_all()
        except Exception as error:
            # As for the worker: the node ends, rather than stay and play nothing.
            self.fail(error)

    def _play_all(self) -> None:
        """Play once, or for ever; each time is a session of its own."""
        again = True
        while again:
            reader = self._open_reader()
            if reader is None:
                return
            self._begin_session(f"bag '{reader.path.name}'", 0)
            if not self._player.play(reader):
                return
            self._bag_warnings = "; ".join(reader.warnings)
            for warning in reader.warnings:
                self.get_logger().warning(warning)
            self.set_state(NodeState.FINISHED)
            again = self._playback.loop
            if again:
                self._wait_until_finished()

    def _wait_until_finished(self) -> None:
        """Return when the awaited nodes have finished: a new session drops what they hold back for images that follow."""
        deadline_s = time.monotonic() + _DRAIN_S
        while time.monotonic() < deadline_s and self._player.rest(_POLL_S):
            awaited = [self.others[name] for name in self._awaited() if name in self.others]
            # Who only listens counts nothing as handled, and never finishes.
            if all(status.state is NodeState.FINISHED for status in awaited if "handled" in status.values):
                return

    def _awaited(self) -> list[str]:
        return [name.strip() for name in self._playback.wait_for.split(",") if name.strip()]

    def _on_jump(self, reason: str, stamp_ns: int) -> None:
        self._begin_session(reason, stamp_ns)

    def _begin_session(self, reason: str, stamp_ns: int) -> None:
        """Raise a session and wait until all have followed; raise another where a newer one is heard of: this is no new graph."""
        deadline_s = time.monotonic() + self._playback.wait_timeout
        self._hear_others(deadline_s)
        number = -1
        while number != self.newest_session:
            number = self.raise_session(reason, stamp_ns).number
            self._wait_for_all(number, deadline_s)
            if not self._player.rest(_SETTLE_S):
                return

    def _hear_others(self, deadline_s: float) -> None:
        """Return when each awaited node has said something, its session too, it takes too long, or all is stopped.

        A driver that is started again would begin with a number that the graph has had, which begins nothing.
        """
        awaited = self._awaited()
        if not awaited:
            self._player.rest(_SETTLE_S)
        while any(name not in self.others for name in awaited) and time.monotonic() < deadline_s:
            if not self._player.rest(_POLL_S):
                return

    def _wait_for_all(self, session: int, deadline_s: float) -> None:
        """Return when the awaited nodes are of the session, it is no more the newest, it takes too long, or all is stopped."""
        names = [self.get_name(), *self._awaited()]
        while missing := [name for name in names if not self._has_followed(name, session)]:
            if session != self.newest_session:
                return
            if time.monotonic() > deadline_s:
                self.get_logger().warning(f"playing without {', '.join(missing)}: not ready in {self._playback.wait_timeout:g} s")
                return
            if not self._player.rest(_POLL_S):
                return

    def _has_followed(self, name: str, session: int) -> bool:
        status = self.others.get(name)
        return (
            status is not None
            and status.state is NodeState.READY
            and status.values.get("session") == str(session)
            and not status.values.get("unmatched")
        )

    def _publish_item(self, item: EncodedImage | ImuSample) -> None:
        if isinstance(item, ImuSample):
            self.send(IMU, imu_to_cdr(item))
            return
        if item.laser_on is not None or item.exposure_s is not None:
            self.send(EXPOSURE, exposure_to_message(item))
        self.send(IMAGE_RAW_COMPRESSED if item.compressed else IMAGE_RAW, encoded_to_cdr(item))


def main() -> None:
    """Run the node."""
    run_node(DriverNode)


if __name__ == "__main__":
    main()
