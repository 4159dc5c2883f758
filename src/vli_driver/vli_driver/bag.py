"""The bag as a source: encoded images and IMU samples in log order."""

from __future__ import annotations

import contextlib
import heapq
import itertools
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from vli_common.arrays import FloatArray, IntArray
from vli_common.errors import InputError, MessageError
from vli_common.types import NANOSECONDS, Counters, EncodedImage, ImuSample
from vli_driver import cdr
from vli_driver.bag_file import BagFile, McapFile, RawMessage, Sqlite3File, TopicInfo

DEFAULT_IMAGE_TOPIC = "/camera/image_raw"
DEFAULT_IMU_TOPIC = "/imu"

_IMAGE_TYPES = (cdr.IMAGE, cdr.COMPRESSED_IMAGE)
_LOG_MARGIN_NS = 2 * NANOSECONDS
_EXPOSURE_WAIT_NS = NANOSECONDS // 10


@dataclass(frozen=True, slots=True)
class BagTopics:
    """Topics to read.

    A default that the bag lacks is replaced by the only topic of a fitting type; a name given by the user is not.

    Args:
        image: Image or CompressedImage; ``NAME`` also finds ``NAME/compressed``.
        imu: Imu.
        camera_info, exposure: optional in the bag.
        imu_required: False lets a bag without an IMU pass (mode ``vl``).
        image_required: False lets a bag without images pass (an IMU at rest).
    """

    image: str = DEFAULT_IMAGE_TOPIC
    imu: str = DEFAULT_IMU_TOPIC
    camera_info: str = "/camera/camera_info"
    exposure: str = "/camera/exposure"
    imu_required: bool = True
    image_required: bool = True


class BagReader:
    """A rosbag2 directory (metadata.yaml may be missing), a bare ``.mcap`` or a ``.db3``.

    Iterating yields :class:`EncodedImage` and :class:`ImuSample` in log order; what the exposure topic says is folded into the
    image of the same stamp. ``start_s`` and ``duration_s`` count from the header stamp of the first image or IMU message.

    Args:
        path: the bag.
        topics: names, or defaults that are adapted to what is there.
        start_s: seconds to skip.
        duration_s: seconds to read, None for all.

    Raises:
        InputError: nothing usable is there; the message says what is, and what to do.
    """

    def __init__(
        self, path: Path | str, topics: BagTopics | None = None, start_s: float = 0.0, duration_s: float | None = None
    ) -> None:
        self.path = Path(path)
        self.warnings: list[str] = []
        self.counters = Counters()
        self.files = _open_files(self.path)
        self.topics = _merge_topics(self.files)
        """Every topic of the bag, with its type and number of messages."""
        self._start_ns = round(start_s * NANOSECONDS)
        self._duration_ns = None if duration_s is None else round(duration_s * NANOSECONDS)
        chosen = topics or BagTopics()
        self.image_topic = self._choose_image(chosen.image) if chosen.image_required else ""
        self.imu_topic = self._choose_imu(chosen)
        self.camera_info_topic = chosen.camera_info if chosen.camera_info in self.topics else None
        self.exposure_topic = chosen.exposure if chosen.exposure in self.topics else None
        self._collect_warnings()

    @property
    def time_range_ns(self) -> tuple[int, int]:
        """Log time of the first and the last message, as far as the file headers tell."""
        return min(file.start_ns for file in self.files), max(file.end_ns for file in self.files)

    def count(self, topic: str | None) -> int:
        """Return the number of stored messages of a topic; zero for one that is not there."""
        return self.topics[topic].count if topic in self.topics else 0

    def camera_info(self) -> Any | None:
        """Return the first camera_info message (as a rosbags dataclass), or None where there is none."""
        if self.camera_info_topic is None:
            return None
        first = next(self._raw({self.camera_info_topic}), None)
        return None if first is None else cdr.read_any(first.data, cdr.CAMERA_INFO)

    def images(self) -> Iterator[EncodedImage]:
        """Yield the images alone, without exposure notes and without counting what is malformed; for checks before a run."""
        msgtype = self.topics[self.image_topic].msgtype
        for message in self._selected():
            if message.topic == self.image_topic:
                with contextlib.suppress(MessageError):
                    yield cdr.read_image(message.data, msgtype)

    def __iter__(self) -> Iterator[EncodedImage | ImuSample]:
        """Yield images and IMU samples in log order; what is malformed is dropped, counted, and told once."""
        joiner = ExposureJoiner() if self.exposure_topic else None
        for message in self._selected():
            item = self._read(message)
            if joiner is None or item is None:
                if isinstance(item, EncodedImage | ImuSample):
                    yield item
                continue
            yield from joiner.push(item, message.log_ns)
        if joiner is not None:
            yield from joiner.flush()
        self._collect_warnings()

    def imu_blocks(self, size: int = 10_000) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
        """Yield all IMU samples in blocks: stamps (N,) ns, rates (N, 3), specific forces (N, 3); for recordings of hours.

        A malformed message is dropped and counted, as in iterating.
        """
        raw = (message.data for message in self._raw({self.imu_topic or ""}))
        while block := list(itertools.islice(raw, size)):
            try:
                yield cdr.read_imus(block)
            except MessageError:
                yield cdr.read_imus([data for data in block if self._is_imu(data)])
        self._collect_warnings()

    def _is_imu(self, data: bytes) -> bool:
        try:
            cdr.read_imu(data)
        except MessageError:
            self.counters.add("malformed")
            return False
        return True

    def _selected(self) -> Iterator[RawMessage]:
        """Yield the messages within start and duration, by header stamp."""
        wanted = {topic for topic in (self.image_topic, self.imu_topic, self.exposure_topic) if topic}
        if self._start_ns <= 0 and self._duration_ns is None:
            yield from self._raw(wanted)
            return
        first = next(self._raw(wanted - {self.exposure_topic or ""}), None)
        if first is None:
            return
        begin_ns = self._stamp(first) + self._start_ns
        end_ns = None if self._duration_ns is None else begin_ns + self._duration_ns
        log_begin = first.log_ns + self._start_ns
        # Log and header clocks may differ by an offset and some latency: a margin keeps what the header stamps select.
        log_end = None if self._duration_ns is None else log_begin + self._duration_ns + _LOG_MARGIN_NS
        for message in self._raw(wanted, log_begin - _LOG_MARGIN_NS, log_end):
            stamp_ns = self._stamp(message)
            if stamp_ns >= begin_ns and (end_ns is None or stamp_ns < end_ns):
                yield message

    @staticmethod
    def _stamp(message: RawMessage) -> int:
        """Return the header stamp, for a malformed message (which is dropped later) its log time."""
        try:
            return cdr.header_stamp(message.data)
        except MessageError:
            return message.log_ns

    def _raw(self, topics: set[str], start_ns: int = 0, end_ns: int | None = None) -> Iterator[RawMessage]:
        streams = [file.messages(topics, start_ns, end_ns) for file in self.files]
        return streams[0] if len(streams) == 1 else heapq.merge(*streams, key=lambda message: message.log_ns)

    def _read(self, message: RawMessage) -> EncodedImage | ImuSample | cdr.ExposureNote | None:
        """Return the message as data; a malformed one is dropped and counted."""
        try:
            if message.topic == self.image_topic:
                return self._checked(cdr.read_image(message.data, self.topics[message.topic].msgtype))
            if message.topic == self.imu_topic:
                return cdr.read_imu(message.data)
            return cdr.read_exposure(message.data)
        except MessageError as error:
            self.counters.add("malformed")
            if self.counters["malformed"] == 1:
                self.warnings.append(f"'{message.topic}': {error}; such messages are dropped")
            return None

    def _checked(self, image: EncodedImage) -> EncodedImage:
        if image.stamp_ns == 0:
            self.counters.add("zero_stamp")
            if self.counters["zero_stamp"] > 1:
                raise InputError(
                    f"images on '{self.image_topic}' are stamped '0'; expected the time of mid-exposure in header.stamp: "
                    "fix the camera driver and record again"
                )
        return image

    def _choose_image(self, name: str) -> str:
        for candidate in (name, f"{name}/compressed"):
            if candidate in self.topics:
                return self._typed(candidate, _IMAGE_TYPES, "sensor_msgs/Image or CompressedImage")
        candidates = self._of_type(_IMAGE_TYPES)
        # X and X/compressed are one camera: the raw one serves.
        cameras = [
            topic
            for topic in candidates
            if topic.removesuffix("/compressed") == topic or topic.removesuffix("/compressed") not in candidates
        ]
        if name != DEFAULT_IMAGE_TOPIC or not cameras:
            raise self._missing("image", name)
        if len(cameras) > 1:
            raise InputError(
                f"'{self.path}' has {len(cameras)} image topics ({', '.join(cameras)}); choose one with --topic "
                f"image={cameras[0]}"
            )
        return cameras[0]

    def _choose_imu(self, topics: BagTopics) -> str | None:
        if topics.imu in self.topics:
            return self._typed(topics.imu, (cdr.IMU,), "sensor_msgs/Imu")
        candidates = self._of_type((cdr.IMU,))
        if topics.imu == DEFAULT_IMU_TOPIC and len(candidates) == 1:
            return candidates[0]
        if not topics.imu_required:
            return None
        if topics.imu == DEFAULT_IMU_TOPIC and candidates:
            raise InputError(
                f"'{self.path}' has {len(candidates)} IMU topics ({', '.join(candidates)}); choose one with "
                f"--topic imu={candidates[0]}"
            )
        raise self._missing("imu", topics.imu)

    def _of_type(self, types: tuple[str, ...]) -> list[str]:
        return sorted(topic for topic, info in self.topics.items() if info.msgtype in types and info.count)

    def _typed(self, topic: str, types: tuple[str, ...], expected: str) -> str:
        if self.topics[topic].msgtype not in types:
            raise InputError(f"topic '{topic}' in '{self.path}' has type '{self.topics[topic].msgtype}', expected {expected}")
        return topic

    def _missing(self, kind: str, name: str) -> InputError:
        there = ", ".join(f"{topic} ({info.msgtype})" for topic, info in sorted(self.topics.items())) or "no topics at all"
        without = " or run without it: --mode vl" if kind == "imu" else ""
        return InputError(
            f"'{self.path}' has no {kind} topic '{name}'; it has {there}; choose one with --topic {kind}=/name{without}"
        )

    def _collect_warnings(self) -> None:
        for file in self.files:
            self.warnings += [warning for warning in file.warnings if warning not in self.warnings]


class ExposureJoiner:
    """Folds what the exposure topic says into the image of the same stamp, whichever comes first.

    Items keep their order: an image waits at most 0.1 s of log time for its note, what comes after it waits with it.
    """

    def __init__(self) -> None:
        self._notes: dict[int, cdr.ExposureNote] = {}
        self._waiting: deque[tuple[int, EncodedImage | ImuSample]] = deque()

    def push(self, item: EncodedImage | ImuSample | cdr.ExposureNote, log_ns: int) -> list[EncodedImage | ImuSample]:
        """Take one item; return those that are ready, in order."""
        if isinstance(item, cdr.ExposureNote):
            self._notes[item.stamp_ns] = item
        else:
            self._waiting.append((log_ns, item))
        ready: list[EncodedImage | ImuSample] = []
        while self._waiting and self._is_ready(*self._waiting[0], log_ns):
            ready.append(self._joined(self._waiting.popleft()[1]))
        return ready

    def flush(self) -> list[EncodedImage | ImuSample]:
        """Return what still waits."""
        ready = [self._joined(item) for _, item in self._waiting]
        self._waiting.clear()
        return ready

    def _is_ready(self, logged_ns: int, item: EncodedImage | ImuSample, now_ns: int) -> bool:
        return isinstance(item, ImuSample) or item.stamp_ns in self._notes or now_ns - logged_ns > _EXPOSURE_WAIT_NS

    def _joined(self, item: EncodedImage | ImuSample) -> EncodedImage | ImuSample:
        if isinstance(item, ImuSample):
            return item
        note = self._notes.pop(item.stamp_ns, None)
        if len(self._notes) > 1000:
            self._notes.clear()
        return item if note is None else replace(item, exposure_s=note.exposure_s, laser_on=note.laser_on)


def _open_files(path: Path) -> list[BagFile]:
    """Return the files of a bag, in time order."""
    if not path.exists():
        raise InputError(f"bag '{path}' does not exist; expected a rosbag2 directory or an .mcap file")
    names = _files_of(path) if path.is_dir() else [path]
    files: list[BagFile] = []
    for name in names:
        if name.suffix == ".mcap":
            files.append(McapFile(name))
        elif name.suffix == ".db3":
            files.append(Sqlite3File(name))
        else:
            raise InputError(f"'{name}' is no bag; expected a rosbag2 directory, an .mcap or a .db3 file")
    return sorted(files, key=lambda file: file.start_ns)


def _files_of(directory: Path) -> list[Path]:
    _check_metadata(directory)
    for suffix in (".mcap", ".db3"):
        if found := sorted(directory.glob(f"*{suffix}")):
            return found
    if packed := sorted(directory.glob("*.zstd")):
        raise InputError(f"'{packed[0]}' is compressed as a file; unpack it with: zstd -d '{packed[0]}'")
    there = ", ".join(sorted(item.name for item in directory.iterdir())) or "nothing"
    raise InputError(f"'{directory}' holds no .mcap or .db3 file (it holds {there}); expected a rosbag2 directory")


def _check_metadata(directory: Path) -> None:
    """Refuse per-message compression, which only metadata.yaml tells; for nothing else it is needed."""
    metadata = directory / "metadata.yaml"
    if not metadata.is_file():
        return
    try:
        information = yaml.safe_load(metadata.read_text(errors="replace"))["rosbag2_bagfile_information"]
    except (yaml.YAMLError, KeyError, TypeError):
        return
    if str(information.get("compression_mode", "")).upper() == "MESSAGE":
        raise InputError(
            f"'{directory}' is compressed message by message; convert it with: ros2 bag convert (mcap with chunk compression)"
        )


def _merge_topics(files: list[BagFile]) -> dict[str, TopicInfo]:
    merged: dict[str, TopicInfo] = {}
    for file in files:
        for topic, info in file.topics.items():
            merged.setdefault(topic, TopicInfo(info.msgtype)).count += info.count
    return merged
