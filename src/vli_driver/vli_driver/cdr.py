"""Fast readers of the few CDR messages that a bag must yield at sensor rate.

The layout is XCDR1 as ROS 2 writes it: a four-byte encapsulation header, then fields aligned to their own size, counted from
the end of that header. Everything else goes through the typestore of ``rosbags``.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from rosbags.typesys import Stores, get_typestore

from vli_common.arrays import AnyArray, ByteArray, FloatArray, IntArray
from vli_common.errors import MessageError
from vli_common.types import NANOSECONDS, EncodedImage, ImuSample

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMU = "sensor_msgs/msg/Imu"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

T = TypeVar("T")

_STORE = get_typestore(Stores.ROS2_JAZZY)
_ENCAPSULATION = 4
_IMU_DOUBLES = 37


@dataclass(frozen=True, slots=True)
class ExposureNote:
    """What the exposure topic says of one frame: exposure in seconds and laser state, None where the key is absent."""

    stamp_ns: int
    exposure_s: float | None
    laser_on: bool | None


class _Cursor:
    """Walks through one message; offsets count from the end of the encapsulation header."""

    __slots__ = ("data", "offset", "order")

    def __init__(self, data: bytes) -> None:
        if len(data) < _ENCAPSULATION or data[0] != 0 or data[1] > 1:
            raise MessageError(f"message of {len(data)} bytes starts with '{data[:4].hex()}', expected a CDR header '00010000'")
        self.data = memoryview(data)[_ENCAPSULATION:]
        self.order = "<" if data[1] else ">"
        self.offset = 0

    def number(self, code: str) -> Any:
        """Read one number of a struct code, aligned to its size."""
        size = struct.calcsize(code)
        self.align(size)
        (value,) = struct.unpack_from(self.order + code, self.data, self.offset)
        self.offset += size
        return value

    def align(self, size: int) -> None:
        """Go on to a multiple of ``size``."""
        self.offset += -self.offset % size

    def raw(self) -> bytes:
        """Read a sequence of octets."""
        length = self.number("I")
        start, self.offset = self.offset, self.offset + length
        if self.offset > len(self.data):
            raise MessageError(f"message holds {len(self.data)} bytes, its fields need '{self.offset}'")
        return bytes(self.data[start : self.offset])

    def text(self) -> str:
        """Read a string."""
        return self.raw().rstrip(b"\0").decode(errors="replace")

    def stamp(self) -> int:
        """Read a std_msgs/Header, return its stamp."""
        seconds, nanoseconds = self.number("i"), self.number("I")
        self.text()
        return int(seconds) * NANOSECONDS + int(nanoseconds)


def header_stamp(data: bytes) -> int:
    """Return header.stamp in nanoseconds of any message that starts with a header.

    Raises:
        MessageError: the bytes are no such message.
    """
    return _guarded(lambda cursor: cursor.stamp(), data)


def read_image(data: bytes, msgtype: str) -> EncodedImage:
    """Return an Image or CompressedImage message undecoded.

    Raises:
        MessageError: the bytes are no such message.
    """
    return _guarded(_compressed_image if msgtype == COMPRESSED_IMAGE else _raw_image, data)


def read_imu(data: bytes) -> ImuSample:
    """Return the sample of an Imu message.

    Raises:
        MessageError: the bytes are no such message.
    """
    return _guarded(_imu, data)


def read_imus(messages: Sequence[bytes]) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return stamps (N,) ns, angular rates (N, 3) and specific forces (N, 3) of many Imu messages, some 20 times faster.

    Raises:
        MessageError: one of the messages is malformed.
    """
    if len({(len(data), data[:_ENCAPSULATION]) for data in messages}) > 1 or not messages:
        samples = [read_imu(data) for data in messages]
        stamps = np.array([sample.stamp_ns for sample in samples], dtype=np.int64)
        gyro, accel = ([getattr(sample, name) for sample in samples] for name in ("gyro", "accel"))
        return stamps, np.array(gyro).reshape(-1, 3), np.array(accel).reshape(-1, 3)
    first = _Cursor(messages[0])
    read_imu(messages[0])
    first.stamp()
    first.align(8)
    rows = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), -1)[:, _ENCAPSULATION:]
    seconds, nanoseconds = (_field(rows, first.order + code, offset, 1)[:, 0] for code, offset in (("i4", 0), ("u4", 4)))
    values = _field(rows, first.order + "f8", first.offset, _IMU_DOUBLES).astype(np.float64)
    return seconds.astype(np.int64) * NANOSECONDS + nanoseconds.astype(np.int64), values[:, 13:16], values[:, 25:28]


def read_exposure(data: bytes) -> ExposureNote:
    """Return what a DiagnosticArray on the exposure topic says (keys ``exposure_s``, ``laser`` = on/off of the first status).

    Raises:
        MessageError: the bytes are no such message, or a value is no number, or the laser neither on nor off.
    """
    message = read_any(data, DIAGNOSTICS)
    stamp_ns = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec
    values = {item.key: item.value for item in message.status[0].values} if message.status else {}
    laser = values.get("laser")
    if laser not in (None, "on", "off"):
        raise MessageError(f"exposure topic: 'laser' is '{laser}', expected on or off")
    try:
        exposure_s = float(values["exposure_s"]) if "exposure_s" in values else None
    except ValueError as error:
        raise MessageError(f"exposure topic: 'exposure_s' is '{values['exposure_s']}', expected seconds") from error
    return ExposureNote(stamp_ns, exposure_s, None if laser is None else laser == "on")


def read_any(data: bytes, msgtype: str) -> Any:
    """Return any message of the Jazzy typestore as its rosbags dataclass.

    Raises:
        MessageError: the bytes are no such message.
    """
    try:
        return _STORE.deserialize_cdr(data, msgtype)
    except Exception as error:  # rosbags compiles its readers: they raise whatever the broken bytes lead to
        raise MessageError(f"malformed {msgtype} of {len(data)} bytes: {error}") from error


def _guarded(reader: Callable[[_Cursor], T], data: bytes) -> T:
    try:
        return reader(_Cursor(data))
    except (struct.error, ValueError) as error:
        raise MessageError(f"malformed message of {len(data)} bytes: {error}") from error


def _field(rows: ByteArray, code: str, offset: int, count: int) -> AnyArray:
    """Return (N, count) numbers that lie at the same offset of every message."""
    kind = np.dtype(code)
    return np.ascontiguousarray(rows[:, offset : offset + count * kind.itemsize]).view(kind)


def _compressed_image(cursor: _Cursor) -> EncodedImage:
    stamp_ns = cursor.stamp()
    encoding = cursor.text()
    return EncodedImage(stamp_ns, cursor.raw(), encoding, compressed=True)


def _raw_image(cursor: _Cursor) -> EncodedImage:
    stamp_ns = cursor.stamp()
    height, width = cursor.number("I"), cursor.number("I")
    encoding = cursor.text()
    is_big_endian = cursor.number("B")
    step = cursor.number("I")
    data = cursor.raw()
    if is_big_endian and encoding.endswith("16"):
        data = np.frombuffer(data, ">u2").astype("<u2").tobytes()
    return EncodedImage(stamp_ns, data, encoding, width, height, step)


def _imu(cursor: _Cursor) -> ImuSample:
    stamp_ns = cursor.stamp()
    cursor.align(8)
    values = np.frombuffer(cursor.data, cursor.order + "f8", _IMU_DOUBLES, cursor.offset).astype(np.float64)
    return ImuSample(stamp_ns, gyro=values[13:16], accel=values[25:28])
