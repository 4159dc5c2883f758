"""Every stage in one process: what the node graph does with topics, done with calls."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass

from vli_backend.backend import BackEnd
from vli_bringup.camera_thread import CameraThread, SortedImage
from vli_bringup.mapping_thread import MappingThread
from vli_bringup.settings import Settings
from vli_bringup.timing import FrameTimer
from vli_common.calibration import Calibration
from vli_common.clock import ClockMonitor
from vli_common.types import (
    BackEndOutput,
    Counters,
    EncodedImage,
    Exposure,
    FrontEndOutput,
    ImuSample,
    LaserScan,
    MappingOutput,
    Mode,
    WindowPoses,
)
from vli_driver.demux import Demultiplexer
from vli_driver.scanner import StripeScanner
from vli_frontend.frontend import FrontEnd
from vli_mapping.mapper import Mapper

_AHEAD = 2
"""Images that the camera's thread may be ahead. Farther ahead than this, it takes the processor from a keyframe."""

Event = BackEndOutput | WindowPoses | MappingOutput
"""What a push may bring: pose, then window; what the map makes of a window comes before the pose of the next keyframe."""


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

    An image is worked on when the two after it have come, so that the camera's thread has the time between for decoding and
    triangulation; the mapping's has the time from one keyframe to the next. Order and results are those of one thread.

    Args:
        stages: see :meth:`Stages.create`.
        mode: which sensors take part.
    """

    def __init__(self, stages: Stages, mode: Mode) -> None:
        self.stages = stages
        self.timer = FrameTimer()
        self.session = 0
        self._counters = Counters()
        self._mode = mode
        self._clock = ClockMonitor()
        self._camera = CameraThread(stages.demultiplexer, stages.scanner, stages.front_end.prepare)
        self._mapping = MappingThread(stages.mapper, self.timer)
        self._queue: deque[Future[list[SortedImage]] | ImuSample] = deque()
        self._images_waiting = 0

    @property
    def counters(self) -> Counters:
        """Images by exposure, IMU samples, sessions, and what had to be left out."""
        return Counters({**self._counters.values, **self._camera.counters.values})

    def push(self, item: EncodedImage | ImuSample) -> list[Event]:
        """Take the next item of the source; return what earlier ones completed."""
        is_image = isinstance(item, EncodedImage)
        events: list[Event] = []
        if jump := self._clock.jump("camera" if is_image else "IMU", item.stamp_ns):
            events += self._begin_session(jump.reason)
        if isinstance(item, ImuSample):
            self._queue.append(item)
            return events
        self._enqueue(self._camera.push(item, self.session))
        return events + self._drain(_AHEAD)

    def flush(self) -> list[Event]:
        """Return what is still held back: images without a verdict, then the window, as final."""
        self._enqueue(self._camera.flush())
        events = [*self._drain(0), *self._hear_map()]
        with self.timer.charge("backend"):
            window = self.stages.back_end.flush()
        events += [*self._map(window), *self._hear_map()]
        self.timer.lap()
        return events

    def _begin_session(self, reason: str) -> list[Event]:
        """Finish what the old clock began, then let every stage start anew; the mapper follows with its first new window."""
        events = self.flush()
        self.session += 1
        self._counters.add("sessions")
        self.stages.front_end.reset(self.session)
        self.stages.back_end.reset(self.session, reason)
        return events

    def _enqueue(self, images: Future[list[SortedImage]]) -> None:
        self._queue.append(images)
        self._images_waiting += 1

    def _drain(self, ahead: int) -> list[Event]:
        """Work off what has been taken so far, in order, until only ``ahead`` images wait; with none, all of it."""
        self.timer.start()
        events: list[Event] = []
        while self._images_waiting > ahead or (not ahead and self._queue):
            item = self._queue.popleft()
            if isinstance(item, ImuSample):
                events += self._push_imu(item)
                continue
            self._images_waiting -= 1
            self.timer.lap()
            for sorted_image in item.result():
                events += self._push_image(sorted_image)
                self.timer.lap()
        self.timer.lap()
        return events

    def _push_imu(self, sample: ImuSample) -> Iterator[Event]:
        if not self._mode.uses_imu:
            return
        self._counters.add("imu_samples")
        with self.timer.charge("frontend"):
            frames = self.stages.front_end.add_imu(sample)
        yield from self._estimate(frames)

    def _push_image(self, item: SortedImage) -> Iterator[Event]:
        self.timer.sorted_in(item.image.stamp_ns, item.exposure is Exposure.LONG, item.costs)
        self._counters.add(f"{item.exposure.value}_images")
        if item.exposure is Exposure.SHORT:
            self._add_scan(item.scan)
            return
        self._mapping.add_image(item.image)
        with self.timer.charge("frontend"):
            frames = self.stages.front_end.add_image(item.image, item.frame)
        yield from self._estimate(frames)

    def _add_scan(self, scan: LaserScan | None) -> None:
        """Give the stripe of a short frame to all who use it."""
        if scan is None:
            return
        with self.timer.charge("frontend"):
            self.stages.front_end.add_scan(scan)
        with self.timer.charge("backend"):
            self.stages.back_end.add_scan(scan)
        self._mapping.add_scan(scan)

    def _estimate(self, frames: list[FrontEndOutput]) -> Iterator[Event]:
        for frame in frames:
            if frame.tracks.keyframe:
                yield from self._hear_map()
            with self.timer.charge("backend"):
                output = self.stages.back_end.add_frame(frame)
            yield output
            if output.pose is not None:
                self.stages.front_end.add_pose(output.pose)
            if output.bias is not None:
                self.stages.front_end.set_bias(output.bias)
            yield from self._map(output.window)

    def _map(self, window: WindowPoses | None) -> Iterator[Event]:
        if window is None:
            return
        yield window
        self._mapping.add_window(window)

    def _hear_map(self) -> Iterator[Event]:
        """Wait for what the map makes of the windows so far, and tell the back end."""
        for update in self._mapping.wait():
            if update.relocalisation is not None:
                self.stages.back_end.relocalise(update.relocalisation)
            if update.constraints is not None:
                self.stages.back_end.add_constraints(update.constraints)
            yield update
