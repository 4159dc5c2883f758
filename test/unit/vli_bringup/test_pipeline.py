"""The wiring of the stages: who gets what, in which order, and the two loops."""

from __future__ import annotations

import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from vli_bringup.pipeline import Pipeline, Stages
from vli_common.types import (
    BackEndOutput,
    EncodedImage,
    Exposure,
    FrontEndOutput,
    ImuBias,
    ImuSample,
    LaserScan,
    MapConstraints,
    MappingOutput,
    Mode,
    TrackingState,
    WindowPoses,
)

MS = 1_000_000
JPEG = bytes(cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1])


class Log(list):
    """Calls of all stages in order, as (stage, method, stamp)."""

    def of(self, *methods):
        return [(method, stamp) for _, method, stamp in self if method in methods]

    def in_main_thread(self):
        return [call for call in self if call[0] != "map"]

    def in_mapping_thread(self):
        return [call for call in self if call[0] == "map"]


class FakeDemultiplexer:
    """Says long and short in turn, a frame late."""

    def __init__(self):
        self.waiting = []
        self.count = 0

    def push(self, image):
        self.waiting.append(image)
        return [self._next()] if len(self.waiting) > 1 else []

    def flush(self):
        return [self._next() for _ in list(self.waiting)]

    def _next(self):
        self.count += 1
        return (Exposure.LONG if self.count % 2 else Exposure.SHORT), self.waiting.pop(0)


class FakeScanner:
    def scan(self, short):
        return LaserScan.empty(short.stamp_ns, short.session)


class FakeFrontEnd:
    """Answers for a long frame when an IMU sample has passed it."""

    def __init__(self, log, uses_imu=True):
        self.log, self.uses_imu, self.waiting = log, uses_imu, []

    def prepare(self, image):
        return image.stamp_ns

    def add_image(self, image, prepared):
        assert prepared == image.stamp_ns
        self.log.append(("front", "image", image.stamp_ns))
        self.waiting.append(image)
        return [] if self.uses_imu else self._answer()

    def add_imu(self, sample):
        self.log.append(("front", "imu", sample.stamp_ns))
        return self._answer(sample.stamp_ns)

    def add_scan(self, scan):
        self.log.append(("front", "scan", scan.stamp_ns))

    def set_bias(self, bias):
        self.log.append(("front", "bias", bias.stamp_ns))

    def reset(self, session):
        self.waiting.clear()
        self.log.append(("front", "reset", session))

    def _answer(self, until_ns=None):
        ready = [image for image in self.waiting if until_ns is None or image.stamp_ns < until_ns]
        self.waiting = [image for image in self.waiting if image not in ready]
        return [FrontEndOutput(SimpleNamespace(stamp_ns=image.stamp_ns, keyframe=True), None) for image in ready]


class FakeBackEnd:
    """Makes every frame a keyframe with a window and a bias."""

    def __init__(self, log):
        self.log, self.session, self.newest = log, 0, None

    def add_scan(self, scan):
        self.log.append(("back", "scan", scan.stamp_ns))

    def add_frame(self, frame):
        self.newest = frame.tracks.stamp_ns
        self.log.append(("back", "frame", self.newest))
        bias = ImuBias(self.newest, np.zeros(3), np.zeros(3))
        return BackEndOutput(self.newest, TrackingState.TRACKING, "", window=self._window(), bias=bias)

    def add_constraints(self, constraints):
        self.log.append(("back", "constraints", constraints.stamp_ns))

    def flush(self):
        self.log.append(("back", "flush", self.session))
        return None if self.newest is None else self._window()

    def reset(self, session, reason):
        self.session, self.reason, self.newest = session, reason, None
        self.log.append(("back", "reset", session))

    def _window(self):
        empty = np.empty(0)
        return WindowPoses(self.newest, empty, empty, empty, empty, np.empty((0, 4, 4)), self.session)


class FakeMapper:
    def __init__(self, log):
        self.log = log

    def add_image(self, image):
        self.log.append(("map", "image", image.stamp_ns))

    def add_scan(self, scan):
        self.log.append(("map", "scan", scan.stamp_ns))

    def add_window(self, window):
        self.log.append(("map", "window", window.stamp_ns))
        empty = np.empty((0, 3))
        return MappingOutput(MapConstraints(window.stamp_ns, empty, empty, empty, empty, np.empty(0), np.empty(0)))


@pytest.fixture
def log():
    return Log()


@pytest.fixture
def pipeline(log):
    stages = Stages(FakeDemultiplexer(), FakeScanner(), FakeFrontEnd(log), FakeBackEnd(log), FakeMapper(log))
    return Pipeline(stages, Mode.VLI_SLAM)


def image(milliseconds, data=JPEG):
    return EncodedImage(milliseconds * MS, data, "jpeg", compressed=True)


def imu(milliseconds):
    return ImuSample(milliseconds * MS, np.zeros(3), np.array([0, 0, 9.81]))


def play(pipeline, images=7, start=1000):
    """Push a 60 Hz camera and a 200 Hz IMU in log order; return the events. The last images only push out those before."""
    items = [image(start + 16 * index) for index in range(images)] + [imu(start + 5 * index) for index in range(4 * images)]
    return [event for item in sorted(items, key=lambda item: item.stamp_ns) for event in pipeline.push(item)]


def test_long_frames_go_to_front_end_and_map_and_short_ones_as_scans_to_all(pipeline, log):
    play(pipeline)
    pipeline.flush()
    for calls, stages in ((log.in_main_thread(), ("front", "back")), (log.in_mapping_thread(), ("map",))):
        images = [stamp // MS for _, method, stamp in calls if method == "image"]
        assert images == [1000, 1032, 1064, 1096]
        scans = [(stage, stamp // MS) for stage, method, stamp in calls if method == "scan"]
        assert scans == [(stage, stamp) for stamp in (1016, 1048, 1080) for stage in stages]
    assert pipeline.counters["long_images"] == 4
    assert pipeline.counters["short_images"] == 3


def test_constraints_of_one_keyframe_come_before_the_solve_of_the_next(pipeline, log):
    play(pipeline)
    pipeline.flush()
    calls = [(method, stamp // MS) for method, stamp in log.of("frame", "constraints")]
    assert calls[:6] == [(method, stamp) for stamp in (1000, 1032, 1064) for method in ("frame", "constraints")]


def test_the_bias_of_a_keyframe_reaches_the_front_end_before_its_next_frame(pipeline, log):
    play(pipeline)
    pipeline.flush()
    assert [method for method, _ in log.of("frame", "bias")] == ["frame", "bias"] * 3


def test_events_come_in_the_order_pose_window_map(pipeline):
    events = [*play(pipeline), *pipeline.flush()]
    assert [type(event) for event in events] == [BackEndOutput, WindowPoses, MappingOutput] * 3 + [WindowPoses, MappingOutput]


def test_the_end_of_input_releases_held_images_and_flushes_the_window_into_the_map(pipeline, log):
    play(pipeline)
    assert ("front", "image", 1096 * MS) not in log
    events = pipeline.flush()
    last = [method for _, method, _ in log.in_main_thread() if method != "imu"][-6:]
    assert last == ["scan", "scan", "image", "constraints", "flush", "constraints"]
    assert [method for _, method, _ in log.in_mapping_thread()[-4:]] == ["window", "scan", "image", "window"]
    assert isinstance(events[-2], WindowPoses)


def test_what_comes_out_does_not_depend_on_which_thread_is_faster(log, monkeypatch):
    runs = []
    for slow, method in ((FakeScanner, "scan"), (FakeFrontEnd, "add_image"), (FakeMapper, "add_window")):
        delayed = Log()
        stages = Stages(FakeDemultiplexer(), FakeScanner(), FakeFrontEnd(delayed), FakeBackEnd(delayed), FakeMapper(delayed))
        original = getattr(slow, method)
        with monkeypatch.context() as patch:
            patch.setattr(slow, method, lambda self, *items, original=original: (time.sleep(0.01), original(self, *items))[1])
            slowed = Pipeline(stages, Mode.VLI_SLAM)
            play(slowed)
            slowed.flush()
        runs.append((delayed.in_main_thread(), delayed.in_mapping_thread()))
    assert runs[0] == runs[1] == runs[2]


def test_a_clock_jump_finishes_the_old_session_and_starts_all_stages_anew(pipeline, log):
    play(pipeline, start=100_000)
    play(pipeline, start=1000)
    pipeline.flush()
    calls = log.in_main_thread()
    at = calls.index(("back", "reset", 1))
    assert [method for _, method, _ in calls[at - 4 : at]] == ["constraints", "flush", "constraints", "reset"]
    assert all(stamp >= 100_000 * MS for _, method, stamp in calls[:at] if method == "frame")
    assert all(stamp < 100_000 * MS for _, method, stamp in calls[at:] if method == "frame")
    assert (
        pipeline.stages.back_end.reason == "the clock of the IMU jumped by -98.9 s"
        or "jumped by -" in pipeline.stages.back_end.reason
    )
    assert pipeline.session == 1
    assert pipeline.stages.back_end.session == 1
    assert pipeline.counters["sessions"] == 1


def test_images_carry_the_session_they_belong_to(pipeline, log, monkeypatch):
    sessions = []
    monkeypatch.setattr(pipeline.stages.mapper, "add_image", lambda image: sessions.append(image.session))
    play(pipeline, start=100_000)
    play(pipeline, start=1000)
    pipeline.flush()
    assert set(sessions) == {0, 1}
    assert sessions == sorted(sessions)


def test_an_image_that_cannot_be_decoded_is_dropped_and_counted(pipeline):
    play(pipeline)
    pipeline.push(image(1500, b"no image"))
    pipeline.flush()
    assert pipeline.counters["undecodable_images"] == 1


def test_without_laser_short_frames_are_not_scanned(log):
    stages = Stages(FakeDemultiplexer(), None, FakeFrontEnd(log), FakeBackEnd(log), FakeMapper(log))
    pipeline = Pipeline(stages, Mode.VI)
    play(pipeline)
    pipeline.flush()
    assert log.of("scan") == []
    assert len(log.of("frame")) == 3


def test_without_imu_its_samples_stay_outside(log):
    stages = Stages(FakeDemultiplexer(), FakeScanner(), FakeFrontEnd(log, uses_imu=False), FakeBackEnd(log), FakeMapper(log))
    pipeline = Pipeline(stages, Mode.VL)
    play(pipeline)
    pipeline.flush()
    assert log.of("imu") == []
    assert len(log.of("frame")) == 4


def test_every_long_frame_has_its_cost(pipeline):
    play(pipeline)
    pipeline.flush()
    costs = pipeline.timer.milliseconds()
    assert len(costs) == pipeline.counters["long_images"]
    assert (costs[:, 0] > 0).all()
