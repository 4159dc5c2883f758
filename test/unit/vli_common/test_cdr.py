"""CDR: what ROS writes is read, in both byte orders; what is cut or claims more than there is, is refused."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Vector3
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import CompressedImage, Image, Imu

from vli_common import cdr
from vli_common.errors import MessageError

STORE = get_typestore(Stores.ROS2_JAZZY)
FRAMES = ["", "a", "imu", "imu_link", "a frame of some length, to move what follows"]


def imu(frame: str) -> Imu:
    message = Imu()
    message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id = 17, 123_456_789, frame
    message.orientation.w = 0.5
    for field, start in (("angular_velocity", 1.0), ("linear_acceleration", -4.0)):
        vector = getattr(message, field)
        vector.x, vector.y, vector.z = start, start + 0.25, start + 0.5
        setattr(message, f"{field}_covariance", np.arange(9.0) + start)
    return message


def image(frame: str) -> Image:
    message = Image(height=2, width=3, encoding="bgr8", step=10, is_bigendian=1, data=range(20))
    message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id = 17, 5, frame
    return message


def compressed(frame: str) -> CompressedImage:
    message = CompressedImage(format="bayer_rggb8; png compressed", data=range(7))
    message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id = 2**31 - 1, 5, frame
    return message


MESSAGES = {cdr.IMU: imu, cdr.IMAGE: image, cdr.COMPRESSED_IMAGE: compressed}


def swapped(data: bytes, name: str) -> bytes:
    """Return the same message in big-endian order."""
    return bytes(STORE.serialize_cdr(STORE.deserialize_cdr(data, name), name, little_endian=False))


def plain(value: Any) -> Any:
    """Return a field in a form that can be compared."""
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return {name: plain(getattr(value, name)) for name in value._fields}
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    return value if isinstance(value, str | int | float) else list(value)


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("name", MESSAGES)
def test_fields_are_those_of_the_message(name: str, frame: str, order: str) -> None:
    message = MESSAGES[name](frame)
    data = serialize_message(message)
    found = plain(cdr.read(cdr.READERS[name], data if order == "little" else swapped(data, name)))
    whole = plain(message)
    assert found == {field: whole[field] for field in found}


@pytest.mark.parametrize("frame", FRAMES)
def test_an_image_is_written_as_ros_reads_it(frame: str) -> None:
    message = image(frame)
    found = cdr.read(cdr.image, serialize_message(message))
    assert deserialize_message(cdr.write_image(found), Image) == message


@pytest.mark.parametrize("frame", FRAMES)
def test_a_compressed_image_is_written_as_ros_reads_it(frame: str) -> None:
    message = compressed(frame)
    found = cdr.read(cdr.compressed_image, serialize_message(message))
    assert deserialize_message(cdr.write_compressed_image(found), CompressedImage) == message


@pytest.mark.parametrize("frame", FRAMES)
def test_a_sample_is_written_as_ros_reads_it(frame: str) -> None:
    expected = Imu(header=imu(frame).header)
    expected.orientation_covariance[0] = -1.0
    expected.angular_velocity, expected.linear_acceleration = Vector3(x=1.0, y=2.0, z=3.0), Vector3(x=4.0, y=5.0, z=6.0)
    header = cdr.read(cdr.imu, serialize_message(expected)).header
    data = cdr.write_imu(header, np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]))
    assert deserialize_message(data, Imu) == expected


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_that_is_cut_anywhere_is_refused(name: str) -> None:
    data = serialize_message(MESSAGES[name]("camera"))
    used = max(size for size in range(len(data)) if not _is_read(name, data[:size])) + 1
    assert len(data) - used < 4, "no more than padding may be missing"
    assert not any(_is_read(name, data[:size]) for size in range(used))


def _is_read(name: str, data: bytes) -> bool:
    try:
        cdr.read(cdr.READERS[name], data)
    except MessageError:
        return False
    return True


def test_a_length_beyond_the_message_is_refused_without_taking_memory() -> None:
    data = bytearray(serialize_message(compressed("")))
    data[-7 - 4 - 1 : -7 - 1] = b"\xff" * 4
    with pytest.raises(MessageError, match="its fields need"):
        cdr.read(cdr.compressed_image, bytes(data))


@pytest.mark.parametrize("start", [b"", b"\x00", b"\x00\x02\x00\x00", b"\x01\x01\x00\x00"])
def test_what_does_not_begin_as_cdr_is_refused(start: bytes) -> None:
    with pytest.raises(MessageError, match=re.escape(f"starts with '{start.hex()}'")):
        cdr.read(cdr.imu, start)


def test_text_that_is_none_is_no_error() -> None:
    data = serialize_message(imu("abcd")).replace(b"abcd", b"\xff\xfe\xfd\xfc")
    assert cdr.read(cdr.imu, data).header.frame_id == "\ufffd" * 4
