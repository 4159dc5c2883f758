"""One interleaved stream in; long images, short images and laser points out."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

from vli_common.calibration import Calibration
from vli_common.clock import ClockMonitor
from vli_common.config import parameter
from vli_common.errors import InputError
from vli_common.messages import (
    Session,
    encoded_from_message,
    exposure_from_message,
    image_to_cdr,
    scan_to_message,
)
from vli_common.node import VliNode, run_node
from vli_common.status import Health
from vli_common.topics import EXPOSURE, IMAGE_LONG, IMAGE_RAW, IMAGE_RAW_COMPRESSED, IMAGE_SHORT, LASER_POINTS
from vli_common.types import Counters, EncodedImage, Exposure, Image
from vli_driver.bag import ExposureJoiner
from vli_driver.cdr import ExposureNote
from vli_driver.config import DemuxConfig, StripeConfig
from vli_driver.decode import decode
from vli_driver.demux import Demultiplexer
from vli_driver.scanner import StripeScanner
from vli_driver.warm_up import warm_up

_PAIR = 2
"""What an overloaded node leaves out is a long and a short image, so that those it keeps still alternate."""


@dataclass(frozen=True)
class InputTopics:
    """Where the camera is."""

    image_topic: str = parameter(IMAGE_RAW.name, doc="Image; NAME/compressed is heard as well")
    exposure_topic: str = parameter(EXPOSURE.name, doc="optional, DiagnosticArray with exposure_s and laser")


class DemuxNode(VliNode):
    """Demultiplexer and stripe scanner; a jump of the camera's clock, or a bag that begins again, begins a new session."""

    def __init__(self) -> None:
        super().__init__("demux_node", {DemuxConfig: "demux", StripeConfig: "stripe", InputTopics: ""}, fixed=[InputTopics])
        self._demultiplexer = Demultiplexer(self.parameters.config(DemuxConfig))
        self._scanner: StripeScanner | None = None
        self._joiner: ExposureJoiner | None = None
        self._jumps = ClockMonitor()
        for topic in (IMAGE_LONG, IMAGE_SHORT, LASER_POINTS):
            self.advertise(topic)
        names = self.parameters.config(InputTopics)
        compressed = names.image_topic.removesuffix("/compressed") + "/compressed"
        self.receive(IMAGE_RAW, encoded_from_message, self._on_item, names.image_topic, required=False, sheds=_PAIR)
        self.receive(IMAGE_RAW_COMPRESSED, encoded_from_message, self._on_item, compressed, required=False, sheds=_PAIR)
        self.receive(EXPOSURE, _read_exposure, self._on_item, names.exposure_topic, ends=False, required=False)

    def create_stage(self, calibration: Calibration | None) -> None:
        """Make demultiplexer and scanner; there is no scanner in a mode without laser."""
        warm_up()
        self._demultiplexer = Demultiplexer(self.parameters.config(DemuxConfig))
        if calibration is not None and self.mode.uses_laser:
            self._scanner = StripeScanner(calibration, self.parameters.config(StripeConfig))

    def drop_stage(self) -> None:
        """Let go of the scanner."""
        self._scanner = None

    def on_session(self, session: Session) -> None:
        """Begin a stream."""
        self._demultiplexer.reset()
        self._joiner = None
        self._jumps = ClockMonitor()

    def on_pause(self) -> None:
        """Hand on what waits for a verdict."""
        self.on_finish()

    def on_finish(self) -> None:
        """Hand on what waits: images for their exposure note, then for a verdict."""
        for item in self._joiner.flush() if self._joiner else ():
            self._on_image(item)
        self._emit(self._demultiplexer.flush())

    def stage_counters(self) -> Counters:
        """Return the counters of demultiplexer and scanner."""
        scanner = self._scanner.counters.values if self._scanner else {}
        return Counters({**self._demultiplexer.counters.values, **scanner})

    def stage_status(self) -> tuple[Health, str, dict[str, str]]:
        """Return what is wrong with the stripe."""
        hint = self._scanner.hint if self._scanner else ""
        return Health.WARN if hint else Health.OK, hint, {}

    def _on_item(self, item: EncodedImage | ExposureNote) -> None:
        """Join images with the notes of the exposure topic, from the first note on."""
        if isinstance(item, ExposureNote) and self._joiner is None:
            self._joiner = ExposureJoiner()
        for ready in self._joiner.push(item, time.time_ns()) if self._joiner else [item]:
            self._on_image(ready)

    def _on_image(self, item: Any) -> None:
        if not isinstance(item, EncodedImage):
            return
        if jump := self._jumps.jump("camera", item.stamp_ns):
            self._demultiplexer.counters.add(jump.counter)
            self.raise_session(jump.reason, item.stamp_ns)
            self.enqueue(lambda: self._sort(item))
            return
        self._sort(item)

    def _sort(self, item: EncodedImage) -> None:
        try:
            image = replace(decode(item), session=self.session)
            self._check_size(image)
        except InputError as error:
            self.counters.add("undecodable_images")
            self.get_logger().warning(str(error), throttle_duration_sec=5.0)
            return
        self._emit(self._demultiplexer.push(image))

    def _check_size(self, image: Image) -> None:
        camera, (height, width) = self.existing(self.calibration).camera, image.pixels.shape[:2]
        if (width, height) != (camera.width, camera.height):
            raise InputError(
                f"image is '{width} x {height}', the calibration is for {camera.width} x {camera.height}; "
                "use the calibration of this camera and resolution"
            )

    def _emit(self, frames: list[tuple[Exposure, Image]]) -> None:
        for exposure, image in frames:
            if exposure is Exposure.LONG:
                self.send(IMAGE_LONG, image_to_cdr(image))
                continue
            if self._scanner is not None:
                self.send(LASER_POINTS, scan_to_message(self._scanner.scan(image)))
            if self.has_listener(IMAGE_SHORT):
                self.send(IMAGE_SHORT, image_to_cdr(image))


def _read_exposure(message: Any) -> ExposureNote:
    return ExposureNote(*exposure_from_message(message))


def main() -> None:
    """Run the node."""
    run_node(DemuxNode)


if __name__ == "__main__":
    main()
