"""The few messages that come at sensor rate or are large, read from their CDR bytes, out of a bag or from a topic, and written.

The layout is XCDR1 as ROS 2 writes it: a four-byte encapsulation header, then fields aligned to their own size, counted from
the end of that header. What is read has the fields of the message by the same names, as far as anyone here needs them; only the
layout is checked. Pixels are not copied.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from vli_common.arrays import FloatArray
from vli_common.errors import MessageError

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMU = "sensor_msgs/msg/Imu"
ENCAPSULATION = 4
"""Bytes before the first field."""
IMU_DOUBLES = 37
"""Numbers of an Imu message, after its header: orientation, angular rate and acceleration, each with its covariance."""
GYRO, ACCEL = slice(13, 16), slice(25, 28)
"""Where among them angular rate and acceleration are."""
NO_DATA = -1.0
"""As the first number of a covariance: what it is of is not there."""
_NO_ROTATION, _ORIENTATION_COVARIANCE = 3, 4
_GYRO_COVARIANCE, _ACCEL_COVARIANCE = slice(16, 25), slice(28, 37)
_DOUBLES = struct.Struct(f"<{IMU_DOUBLES}d")
_LITTLE_ENDIAN = b"\x00\x01\x00\x00"

T = TypeVar("T")


class Stamp(NamedTuple):
    """``builtin_interfaces/Time``."""

    sec: int
    nanosec: int


class Header(NamedTuple):
    """``std_msgs/Header``."""

    stamp: Stamp
    frame_id: str


class Vector(NamedTuple):
    """``geometry_msgs/Vector3``."""

    x: float
    y: float
    z: float


class Imu(NamedTuple):
    """``sensor_msgs/Imu`` without the orientation."""

    header: Header
    angular_velocity: Vector
    angular_velocity_covariance: tuple[float, ...]
    linear_acceleration: Vector
    linear_acceleration_covariance: tuple[float, ...]


class Image(NamedTuple):
    """``sensor_msgs/Image``."""

    header: Header
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: memoryview | bytes


class CompressedImage(NamedTuple):
    """``sensor_msgs/CompressedImage``."""

    header: Header
    format: str
    data: memoryview | bytes


class Cursor:
    """Walks through one message; offsets count from the end of the encapsulation header.

    Args:
        data: of the message.

    Raises:
        MessageError: the bytes do not begin as CDR does.
    """

    __slots__ = ("data", "offset", "order")

    def __init__(self, data: bytes) -> None:
        if len(data) < ENCAPSULATION or data[0] != 0 or data[1] > 1:
            raise MessageError(f"message of {len(data)} bytes starts with '{data[:4].hex()}', expected a CDR header '00010000'")
        self.data = memoryview(data)[ENCAPSULATION:]
        self.order = "<" if data[1] else ">"
        self.offset = 0

    def numbers(self, codes: str, size: int) -> tuple[Any, ...]:
        """Read numbers that follow each other, each of ``size`` bytes and aligned to it; ``codes`` are those of struct."""
        self.align(size)
        values = struct.unpack_from(self.order + codes, self.data, self.offset)
        self.offset += size * len(values)
        return values

    def align(self, size: int) -> None:
        """Go on to a multiple of ``size``."""
        self.offset += -self.offset % size

    def octets(self) -> memoryview:
        """Read a sequence of octets: a view of the message.

        Raises:
            MessageError: it is longer than the message.
        """
        (length,) = self.numbers("I", 4)
        start, self.offset = self.offset, self.offset + length
        if self.offset > len(self.data):
            raise MessageError(f"message holds {len(self.data)} bytes, its fields need '{self.offset}'")
        return self.data[start : self.offset]

    def text(self) -> str:
        """Read a string."""
        return bytes(self.octets()).rstrip(b"\0").decode(errors="replace")

    def header(self) -> Header:
        """Read a std_msgs/Header."""
        stamp = Stamp(*self.numbers("iI", 4))
        return Header(stamp, self.text())


def read(reader: Callable[[Cursor], T], data: bytes) -> T:
    """Return what one of the readers finds in a message.

    Raises:
        MessageError: the bytes are no such message.
    """
    try:
        return reader(Cursor(data))
    except (struct.error, ValueError) as error:
        raise MessageError(f"malformed message of {len(data)} bytes: {error}") from error


def imu(cursor: Cursor) -> Imu:
    """Read an Imu message."""
    header = cursor.header()
    values = cursor.numbers(f"{IMU_DOUBLES}d", 8)
    return Imu(header, Vector(*values[GYRO]), values[_GYRO_COVARIANCE], Vector(*values[ACCEL]), values[_ACCEL_COVARIANCE])


def image(cursor: Cursor) -> Image:
    """Read an Image message."""
    header = cursor.header()
    height, width = cursor.numbers("II", 4)
    encoding = cursor.text()
    (is_bigendian,) = cursor.numbers("B", 1)
    (step,) = cursor.numbers("I", 4)
    return Image(header, height, width, encoding, is_bigendian, step, cursor.octets())


def compressed_image(cursor: Cursor) -> CompressedImage:
    """Read a CompressedImage message."""
    return CompressedImage(cursor.header(), cursor.text(), cursor.octets())


READERS: dict[str, Callable[[Cursor], Any]] = {IMU: imu, IMAGE: image, COMPRESSED_IMAGE: compressed_image}
"""ROS interface name → reader."""


def write_imu(header: Header, gyro: FloatArray, accel: FloatArray) -> bytes:
    """Return the CDR bytes of an Imu message that says of its orientation that there is none.

    Args:
        header: of the sample.
        gyro, accel: (3,) rad/s and m/s².
    """
    values = [0.0] * IMU_DOUBLES
    values[_NO_ROTATION], values[_ORIENTATION_COVARIANCE] = 1.0, NO_DATA
    values[GYRO], values[ACCEL] = gyro.tolist(), accel.tolist()
    start = _header(header)
    return b"".join((_LITTLE_ENDIAN, start, bytes(-len(start) % 8), _DOUBLES.pack(*values)))


def write_image(message: Image) -> bytes:
    """Return the CDR bytes of an Image message; the pixels are copied once."""
    start = _aligned(_header(message.header)) + struct.pack("<II", message.height, message.width) + _string(message.encoding)
    start = _aligned(start + struct.pack("B", message.is_bigendian)) + struct.pack("<II", message.step, len(message.data))
    return b"".join((_LITTLE_ENDIAN, start, message.data))


def write_compressed_image(message: CompressedImage) -> bytes:
    """Return the CDR bytes of a CompressedImage message."""
    start = _aligned(_aligned(_header(message.header)) + _string(message.format)) + struct.pack("<I", len(message.data))
    return b"".join((_LITTLE_ENDIAN, start, message.data))


def _header(header: Header) -> bytes:
    return struct.pack("<iI", *header.stamp) + _string(header.frame_id)


def _string(text: str) -> bytes:
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data


def _aligned(fields: bytes) -> bytes:
    return fields + bytes(-len(fields) % 4)
