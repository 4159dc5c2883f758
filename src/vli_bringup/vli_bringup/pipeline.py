"""Every stage in one process: what the node graph does with topics, done with calls."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from vli_backend.backend import BackEnd
from vli_bringup.settings import Settings
from vli_bringup.timing import FrameTimer
from vli_common.calibration import Calibration
from vli_common.clock import ClockMonitor
from vli_common.errors import InputError
from vli_common.types import (
    BackEndOutput,
    Counters,
    EncodedImage,
    Exposure,
    FrontEndOutput,
    Image,
    ImuSample,
    MappingOutput,
    Mode,
    WindowPoses,
)
from vli_driver.decode import decode
from vli_driver.demux import Demultiplexer
from vli_driver.scanner import StripeScanner
from vli_frontend.frontend import FrontEnd
from vli_mapping.mapper import Mapper

Event = BackEndOutput | WindowPoses | MappingOutput
"""What a push may bring, in this order for each long frame."""


@dataclass
class Stages:
    """The stage objects, wired by :class:`Pipeline`."""

    demultiplexer: Demultiplexer
    scanner: StripeScanner | None
    front_end: FrontEnd
    back_end: BackEnd
    mapper: Mapper

    @staticmethod
    def create(calibration: Calibration, settings: Settings, mode: Mode) -> Stages:
        """Return fresh stages; there is no scanner in a mode without laser."""
        return Stages(
            Demultiplexer(settings.demux),
            StripeScanner(calibration, settings.stripe) if mode.uses_laser else None,
            FrontEnd(calibration, settings.frontend, mode),
            BackEnd(calibration, settings.backend, mode),
            Mapper(calibration, settings.mapping, mode),
        )


class Pipeline:
    """Images and IMU samples in, in log order; poses, windows and map updates out.

    The two loops are those of the graph: constraints found with the window of one keyframe enter the solve of the next, eq. (4),
    and the bias of one keyframe enters the preintegration after it.

    Args:
        stages: see :meth:`Stages.create`.
        mode: which sensors take part.
    """

    def __init__(self, stages: Stages, mode: Mode) -> None:
        self.stages = stages
        self.timer = FrameTimer()
        self.counters = Counters()
        self.session = 0
        self._mode = mode
        self._clock = ClockMonitor()
        self._image_shape: tuple[int, ...] | None = None

    def push(self, item: EncodedImage | ImuSample) -> list[Event]:
        """Take the next item of the source; return what it completed."""
        stream = "camera" if isinstance(item, EncodedImage) else "IMU"
        events: list[Event] = []
        if jump := self._clock.jump(stream, item.stamp_ns):
            events += self._begin_session(jump)
        if isinstance(item, EncodedImage):
            events += self._push_image(item)
        elif self._mode.uses_imu:
            self.counters.add("imu_samples")
            with self.timer.measure("frontend"):
                frames = self.stages.front_end.add_imu(item)
            events += self._estimate(frames)
        return events

    def flush(self) -> list[Event]:
        """Return what is still held back: images without a verdict, then the window, as final."""
        events = [event for exposure, image in self.stages.demultiplexer.flush() for event in self._sorted(exposure, image)]
        with self.timer.measure("backend"):
            window = self.stages.back_end.flush()
        return [*events, *self._map(window)]

    def _begin_session(self, reason: str) -> list[Event]:
        """Finish what the old clock began, then let every stage start anew; the mapper follows with its first new window."""
        events = self.flush()
        self.session += 1
        self.counters.add("sessions")
        self.stages.front_end.reset(self.session)
        self.stages.back_end.reset(self.session, reason)
        return events

    def _push_image(self, encoded: EncodedImage) -> Iterator[Event]:
        try:
            with self.timer.measure_unsorted("decode", encoded.stamp_ns):
                image = replace(decode(encoded), session=self.session)
        except InputError:
            self.counters.add("undecodable_images")
            return
        self._image_shape = self._image_shape or image.pixels.shape
        if image.pixels.shape != self._image_shape:
            self.counters.add("images_of_another_shape")
            return
        with self.timer.measure_unsorted("demux", encoded.stamp_ns):
            ready = self.stages.demultiplexer.push(image)
        for exposure, sorted_image in ready:
            yield from self._sorted(exposure, sorted_image)

    def _sorted(self, exposure: Exposure, image: Image) -> Iterator[Event]:
        self.timer.sorted_in(image.stamp_ns, exposure is Exposure.LONG)
        self.counters.add(f"{exposure.value}_images")
        if exposure is Exposure.SHORT:
            self._scan(image)
            return
        with self.timer.measure("mapping"):
            self.stages.mapper.add_image(image)
        with self.timer.measure("frontend"):
            frames = self.stages.front_end.add_image(image)
        yield from self._estimate(frames)

    def _scan(self, short: Image) -> None:
        """Triangulate the stripe of a short frame, eq. (1), for all who use it."""
        if self.stages.scanner is None:
            return
        with self.timer.measure("stripe"):
            scan = self.stages.scanner.scan(short)
        with self.timer.measure("frontend"):
            self.stages.front_end.add_scan(scan)
        with self.timer.measure("backend"):
            self.stages.back_end.add_scan(scan)
        with self.timer.measure("mapping"):
            self.stages.mapper.add_scan(scan)

    def _estimate(self, frames: list[FrontEndOutput]) -> Iterator[Event]:
        for frame in frames:
            with self.timer.measure("backend"):
                output = self.stages.back_end.add_frame(frame)
            yield output
            if output.bias is not None:
                self.stages.front_end.set_bias(output.bias)
            yield from self._map(output.window)

    def _map(self, window: WindowPoses | None) -> Iterator[Event]:
        if window is None:
            return
        yield window
        with self.timer.measure("mapping"):
            update = self.stages.mapper.add_window(window)
        if update.constraints is not None:
            self.stages.back_end.add_constraints(update.constraints)
        yield update
