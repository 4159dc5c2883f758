"""Storage of one bag file: raw messages in log order, from mcap (whole, truncated, rotten in places) or sqlite3."""

from __future__ import annotations

import contextlib
import sqlite3
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Protocol

from vli_common.errors import InputError
from vli_common.types import NANOSECONDS

_MAGIC = b"\x89MCAP0\r\n"
_FRAME = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")
_SCHEMA, _CHANNEL, _MESSAGE_OP, _CHUNK_OP, _MESSAGE_INDEX, _DATA_END = 0x03, 0x04, 0x05, 0x06, 0x07, 0x0F
_INDEX = struct.Struct("<HI")
_RUN_BYTES = 4 << 20
_MAX_CHUNK_BYTES = 1 << 28
"""Uncompressed. Writers close a chunk after some megabytes; a record that claims more is rotten, or a trap."""


class RawMessage(NamedTuple):
    """One message as stored."""

    log_ns: int
    topic: str
    data: bytes


@dataclass(slots=True)
class TopicInfo:
    """Message type and number of messages of one topic."""

    msgtype: str
    count: int = 0


class BagFile(Protocol):
    """One file of a bag."""

    topics: dict[str, TopicInfo]
    warnings: list[str]
    start_ns: int
    end_ns: int

    def messages(self, topics: Collection[str], start_ns: int = 0, end_ns: int | None = None) -> Iterator[RawMessage]:
        """Yield the messages of ``topics`` in log order; those outside [start_ns, end_ns] (log time) may be left out."""
        ...


@dataclass(frozen=True, slots=True)
class _Segment:
    """A chunk, or a run of unchunked records: its records lie in the file at [offset, offset + length)."""

    offset: int
    length: int
    start_ns: int
    end_ns: int
    compression: str = ""
    size: int = 0
    crc: int = 0
    cut: bool = False


class McapFile:
    """An mcap file, read without its index, so that a file that was cut or has rotten chunks is read like a whole one.

    Opening walks over the record headers only and decompresses chunks just as far as the channels must be known and messages
    counted.

    Raises:
        InputError: the file is empty or is no mcap.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics: dict[str, TopicInfo] = {}
        self.warnings: list[str] = []
        self._channels: dict[int, str] = {}
        self._schemas: dict[int, str] = {}
        self._index_counts: dict[int, int] = {}
        self._bad_segments: set[int] = set()
        with path.open("rb") as stream:
            _check_magic(stream, path)
            self._segments, whole = self._walk(stream)
            self._learn_topics(stream, whole)
        self._segments.sort(key=lambda segment: segment.start_ns)
        self.start_ns = min((segment.start_ns for segment in self._segments), default=0)
        self.end_ns = max((segment.end_ns for segment in self._segments), default=0)

    def messages(self, topics: Collection[str], start_ns: int = 0, end_ns: int | None = None) -> Iterator[RawMessage]:
        """See :meth:`BagFile.messages`."""
        wanted = {channel: topic for channel, topic in self._channels.items() if topic in topics}
        pending: list[RawMessage] = []
        with self.path.open("rb") as stream:
            for segment in self._segments:
                if segment.end_ns < start_ns or (end_ns is not None and segment.start_ns > end_ns):
                    continue
                # Chunks may overlap in time: only what lies before the next one's start is settled.
                settled = [message for message in pending if message.log_ns < segment.start_ns]
                yield from settled
                pending = pending[len(settled) :]
                pending += self._read_segment(stream, segment, wanted)
                pending.sort(key=lambda message: message.log_ns)
        yield from pending

    def _walk(self, stream: BinaryIO) -> tuple[list[_Segment], bool]:
        """Return the segments, and whether the data section is complete."""
        end = self.path.stat().st_size
        offset, segments, run = len(_MAGIC), list[_Segment](), _Run()
        while offset + _FRAME.size <= end:
            stream.seek(offset)
            opcode, length = _FRAME.unpack(stream.read(_FRAME.size))
            body, following = offset + _FRAME.size, offset + _FRAME.size + length
            if opcode == _DATA_END:
                return segments + run.close(), True
            if opcode == _CHUNK_OP:
                segments += run.close() + _chunk_segment(stream, body, length, end)
            elif opcode in (_SCHEMA, _CHANNEL, _MESSAGE_OP) and following <= end:
                segments += run.add(stream, opcode, offset, following)
            elif opcode == _MESSAGE_INDEX and following <= end and length >= _INDEX.size:
                channel, size = _INDEX.unpack(stream.read(_INDEX.size))
                self._index_counts[channel] = self._index_counts.get(channel, 0) + size // 16
            if following > end:
                break
            offset = following
        return segments + run.close(), False

    def _learn_topics(self, stream: BinaryIO, whole: bool) -> None:
        """Find channels and counts: from the summary section where there is one, else from the chunks themselves."""
        counts = dict(self._index_counts)
        if whole:
            self._read_summary(stream)
        if not whole or not set(counts) <= set(self._channels) or (self._segments and not counts):
            counts = self._count(stream)
        for channel, topic in self._channels.items():
            self.topics[topic].count += counts.get(channel, 0)
        if not whole:
            self.warnings.append(self._loss(sum(counts.values())))

    def _read_summary(self, stream: BinaryIO) -> None:
        """Read the records between the end of the data and the footer."""
        stream.seek(max((segment.offset + segment.length for segment in self._segments), default=len(_MAGIC)))
        for opcode, body in _records(stream.read()):
            self._note(opcode, body)

    def _count(self, stream: BinaryIO) -> dict[int, int]:
        counts: dict[int, int] = {}
        for segment in self._segments:
            for opcode, body in _records(self._segment_data(stream, segment)):
                self._note(opcode, body)
                if opcode == _MESSAGE_OP and len(body) >= _MESSAGE.size:
                    channel = _MESSAGE.unpack_from(body)[0]
                    counts[channel] = counts.get(channel, 0) + 1
        return counts

    def _note(self, opcode: int, body: memoryview) -> None:
        """Remember a schema or channel record; one that is too short to be any is passed over."""
        with contextlib.suppress(struct.error):
            if opcode == _SCHEMA:
                self._schemas[struct.unpack_from("<H", body)[0]] = _string(body, 2)
            elif opcode == _CHANNEL:
                channel, schema = struct.unpack_from("<HH", body)
                topic = _string(body, 4)
                self._channels[channel] = topic
                self.topics.setdefault(topic, TopicInfo(self._schemas.get(schema, "")))

    def _read_segment(self, stream: BinaryIO, segment: _Segment, wanted: dict[int, str]) -> list[RawMessage]:
        found: list[RawMessage] = []
        for opcode, body in _records(self._segment_data(stream, segment)):
            if opcode == _MESSAGE_OP and len(body) >= _MESSAGE.size:
                channel, _, log_ns, _ = _MESSAGE.unpack_from(body)
                if channel in wanted:
                    found.append(RawMessage(log_ns, wanted[channel], bytes(body[_MESSAGE.size :])))
        return found

    def _segment_data(self, stream: BinaryIO, segment: _Segment) -> bytes:
        """Return the records of a segment; nothing, and a warning once, where they are rotten."""
        stream.seek(segment.offset)
        data = stream.read(segment.length)
        if segment.cut:
            return data if not segment.compression else b""
        try:
            data = _decompress(data, segment)
        except ValueError as error:
            if segment.offset not in self._bad_segments:
                self._bad_segments.add(segment.offset)
                span_s = (segment.end_ns - segment.start_ns) / NANOSECONDS
                self.warnings.append(f"'{self.path}': a chunk of {span_s:.3f} s at byte {segment.offset} was lost: {error}")
            return b""
        return data

    def _loss(self, count: int) -> str:
        cut = next((segment for segment in self._segments if segment.cut), None)
        last_ns = max((segment.end_ns for segment in self._segments if not segment.cut), default=0)
        first_ns = min((segment.start_ns for segment in self._segments), default=0)
        lost = f", in a cut chunk of {(cut.end_ns - cut.start_ns) / NANOSECONDS:.3f} s" if cut else ""
        span_s = max(last_ns - first_ns, 0) / NANOSECONDS
        return f"'{self.path}' is truncated{lost}: {count} whole messages of {span_s:.1f} s were read, what followed is lost"


class _Run:
    """Joins consecutive unchunked records into segments of a few MB."""

    def __init__(self) -> None:
        self._offset = self._end = 0
        self._times: list[int] = []

    def add(self, stream: BinaryIO, opcode: int, offset: int, following: int) -> list[_Segment]:
        """Append the record at ``offset``; returns the segment that became full."""
        if self._end == 0:
            self._offset = offset
        self._end = following
        head = stream.read(_MESSAGE.size) if opcode == _MESSAGE_OP else b""
        if len(head) == _MESSAGE.size:
            self._times.append(_MESSAGE.unpack(head)[2])
        return self.close() if self._end - self._offset > _RUN_BYTES else []

    def close(self) -> list[_Segment]:
        """Return the segment collected so far, if any."""
        if self._end == 0:
            return []
        times = self._times or [0]
        segment = _Segment(self._offset, self._end - self._offset, min(times), max(times))
        self._offset = self._end = 0
        self._times = []
        return [segment]


class Sqlite3File:
    """A ``.db3`` file of rosbag2.

    Raises:
        InputError: the file is no rosbag2 database.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.warnings: list[str] = []
        with self._connect() as connection:
            rows = self._query(connection, "SELECT id, name, type FROM topics")
            counts = dict(self._query(connection, "SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id"))
            ((start, end),) = self._query(connection, "SELECT MIN(timestamp), MAX(timestamp) FROM messages")
        self.topics = {name: TopicInfo(msgtype, counts.get(key, 0)) for key, name, msgtype in rows}
        self.start_ns, self.end_ns = start or 0, end or 0
        self._names: dict[int, str] = {key: name for key, name, _ in rows}

    def messages(self, topics: Collection[str], start_ns: int = 0, end_ns: int | None = None) -> Iterator[RawMessage]:
        """See :meth:`BagFile.messages`."""
        keys = [key for key, name in self._names.items() if name in topics]
        marks = ",".join("?" * len(keys))
        chosen = f"topic_id IN ({marks}) AND timestamp BETWEEN ? AND ?"
        query = f"SELECT timestamp, topic_id, data FROM messages WHERE {chosen} ORDER BY timestamp"
        with self._connect() as connection:
            try:
                for log_ns, key, data in connection.execute(query, (*keys, start_ns, end_ns if end_ns is not None else 2**62)):
                    yield RawMessage(log_ns, self._names[key], data)
            except sqlite3.Error as error:
                self.warnings.append(f"'{self.path}' is damaged, what follows is lost: {error}")

    def _connect(self) -> sqlite3.Connection:
        return sqlite3.connect(f"file:{self.path}?mode=ro&immutable=1", uri=True)

    def _query(self, connection: sqlite3.Connection, query: str) -> list[Any]:
        try:
            return connection.execute(query).fetchall()
        except sqlite3.Error as error:
            raise InputError(f"'{self.path}' is no rosbag2 database ({error}); record again, or pass an .mcap") from error


def _check_magic(stream: BinaryIO, path: Path) -> None:
    magic = stream.read(len(_MAGIC))
    if not magic:
        raise InputError(f"'{path}' is empty; expected an mcap file, record again")
    if magic != _MAGIC:
        raise InputError(f"'{path}' is no mcap file: it starts with '{magic.hex()}', expected '{_MAGIC.hex()}'")


def _chunk_segment(stream: BinaryIO, body: int, length: int, end: int) -> list[_Segment]:
    """Return the segment of a chunk record (none when even its header is cut)."""
    head = stream.read(min(length, end - body, 64))
    if len(head) < _CHUNK.size:
        return []
    start_ns, end_ns, size, crc, name_length = _CHUNK.unpack_from(head)
    records = body + _CHUNK.size + name_length + 8
    if name_length > 16 or records > end:
        return []
    compression = head[_CHUNK.size : _CHUNK.size + name_length].decode(errors="replace")
    stop = min(body + length, end)
    return [_Segment(records, stop - records, start_ns, end_ns, compression, size, crc, cut=body + length > end)]


def _decompress(data: bytes, segment: _Segment) -> bytes:
    """Return the uncompressed, checked records of a chunk.

    Raises:
        ValueError: it cannot be decompressed, claims an impossible size, or fails its checksum.
    """
    if segment.size > _MAX_CHUNK_BYTES:
        raise ValueError(f"it claims '{segment.size}' bytes, expected at most {_MAX_CHUNK_BYTES}")
    if segment.compression == "zstd":
        data = _unzstd(data, segment.size)
    elif segment.compression == "lz4":
        data = _unlz4(data, segment.size)
    elif segment.compression:
        raise ValueError(f"unknown compression '{segment.compression}', expected zstd, lz4 or none")
    if segment.crc and zlib.crc32(data) != segment.crc:
        raise ValueError("checksum mismatch")
    return data


def _unzstd(data: bytes, size: int) -> bytes:
    import zstandard

    try:
        claimed = zstandard.get_frame_parameters(data).content_size
        if claimed not in (zstandard.CONTENTSIZE_UNKNOWN, size):
            raise ValueError(f"it holds '{claimed}' bytes, expected {size}")
        return zstandard.decompress(data, size)
    except (zstandard.ZstdError, MemoryError) as error:
        raise ValueError(str(error)) from error


def _unlz4(data: bytes, size: int) -> bytes:
    import lz4.frame  # type: ignore[import-untyped]

    try:
        out: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
    except (RuntimeError, MemoryError) as error:
        raise ValueError(str(error)) from error
    return out


def _records(data: bytes) -> Iterator[tuple[int, memoryview]]:
    """Yield opcode and body of the whole records in ``data``."""
    view, offset = memoryview(data), 0
    while offset + _FRAME.size <= len(data):
        opcode, length = _FRAME.unpack_from(data, offset)
        body = offset + _FRAME.size
        offset = body + length
        if offset > len(data):
            return
        yield opcode, view[body:offset]


def _string(body: memoryview, offset: int) -> str:
    (length,) = struct.unpack_from("<I", body, offset)
    return bytes(body[offset + 4 : offset + 4 + length]).decode(errors="replace")
