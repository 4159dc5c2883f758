"""A rosbag2 directory with one mcap file that is sound up to its last whole chunk at every moment."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import IO, cast

import yaml
from mcap.writer import CompressionType, Writer

from vli_bringup.recording.topic import RawMessage, RecordedTopic
from vli_common.errors import OutputError

_METADATA_VERSION = 9
_CHUNK_BYTES = 4 << 20
METADATA = "metadata.yaml"


class BagWriter:
    """Writes messages in chunks, each compressed and with a checksum; nothing is held back beyond the chunk under way.

    Args:
        directory: exists and is empty.
        name: of the bag; its file is ``NAME_0.mcap``.

    Raises:
        OutputError: the file cannot be made.
        OSError: (every method) it cannot be written any further.
    """

    def __init__(self, directory: Path, name: str) -> None:
        self.path = directory / f"{name}_0.mcap"
        self.topics: list[RecordedTopic] = []
        """Those that have messages."""
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        try:
            self._file = _WholeWrites(self.path)
            self._writer = Writer(cast(IO[bytes], self._file), _CHUNK_BYTES, CompressionType.ZSTD)
            self._writer.start(profile="ros2")
        except OSError as error:
            raise OutputError(f"'{self.path}' cannot be written ({error.strerror}); choose another with --out DIR") from error

    def write(self, topic: RecordedTopic, message: RawMessage) -> None:
        """Add a message to the chunk under way."""
        channel = self._channels.get(topic.name) or self._register(topic)
        self._writer.add_message(channel, message.log_ns, message.data, message.publish_ns, message.sequence)
        self._file.mark_sound()
        topic.add(message)

    def flush(self) -> None:
        """End the chunk under way, if it holds anything: from now on it survives this process."""
        self._writer.flush()
        self._file.mark_sound()

    def close(self) -> None:
        """Write index and ``metadata.yaml``, through to the disk."""
        self.flush()
        self._writer.finish()
        self._file.sync()
        self._file.close()
        _write_through(self.path.with_name(METADATA), yaml.safe_dump(self._metadata(), sort_keys=False))

    def abandon(self) -> None:
        """Cut off what was written of an unfinished chunk, and close; index and ``metadata.yaml`` are not there then."""
        with suppress(OSError):
            self._file.cut()
            self._file.close()

    def _register(self, topic: RecordedTopic) -> int:
        if topic.type not in self._schemas:
            self._schemas[topic.type] = self._writer.register_schema(topic.type, "ros2msg", topic.definition.encode())
        channel = self._writer.register_channel(topic.name, "cdr", self._schemas[topic.type], topic.channel_metadata)
        self._channels[topic.name] = channel
        self.topics.append(topic)
        return channel

    def _metadata(self) -> dict[str, object]:
        count = sum(topic.messages for topic in self.topics)
        first_ns = min((topic.first_ns for topic in self.topics), default=0)
        last_ns = max((topic.last_ns for topic in self.topics), default=0)
        return {
            "rosbag2_bagfile_information": {
                "version": _METADATA_VERSION,
                "storage_identifier": "mcap",
                **_span(first_ns, last_ns, count),
                "topics_with_message_count": [topic.metadata for topic in self.topics],
                "compression_format": "",
                "compression_mode": "",
                "relative_file_paths": [self.path.name],
                "files": [{"path": self.path.name, **_span(first_ns, last_ns, count)}],
                "custom_data": None,
                "ros_distro": "jazzy",
            }
        }


def _span(first_ns: int, last_ns: int, count: int) -> dict[str, object]:
    """Return a mapping of its own each time: YAML would write the second use of one as a reference."""
    return {
        "starting_time": {"nanoseconds_since_epoch": first_ns},
        "duration": {"nanoseconds": last_ns - first_ns},
        "message_count": count,
    }


class _WholeWrites:
    """A file whose writes are whole or raise, and which knows up to where it is sound; as much of a stream as mcap asks for."""

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._position = self._sound = 0

    def write(self, data: bytes) -> None:
        """Write all of it, or raise."""
        left = memoryview(data)
        while left:
            written = os.write(self._descriptor, left)
            self._position += written
            left = left[written:]

    def tell(self) -> int:
        """Return how many bytes have been written."""
        return self._position

    def flush(self) -> None:
        """Nothing is held back."""

    def mark_sound(self) -> None:
        """What has been written up to here is a file of its own."""
        self._sound = self._position

    def sync(self) -> None:
        """Return once the disk has it all."""
        os.fsync(self._descriptor)

    def cut(self) -> None:
        """Leave what is sound."""
        os.ftruncate(self._descriptor, self._sound)

    def close(self) -> None:
        """Close the file; more than once does no harm."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)


def _write_through(path: Path, text: str) -> None:
    with path.open("w") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
