"""Messages ⇄ types: stamps, images, the session and the status."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image as ImageMessage
from std_msgs.msg import Header

from vli_common import cdr
from vli_common.camera import CameraModel
from vli_common.errors import MessageError
from vli_common.status import Health, NodeState, StageStatus
from vli_common.topics import CAMERA_FRAME
from vli_common.types import NANOSECONDS, EncodedImage, Image

MAX_SECONDS = 2**31 - 1
_CHANNELS = {"bgr8": 3, "mono8": 1}


@dataclass(frozen=True, slots=True)
class Session:
    """All state of other sessions is dropped; ``stamp_ns`` is the first one of the new session where known, else 0."""

    number: int
    reason: str
    stamp_ns: int = 0


def to_time(stamp_ns: int) -> Time:
    """Return a ROS stamp.

    Raises:
        MessageError: negative, or beyond what 32 bits of seconds hold.
    """
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    if not 0 <= seconds <= MAX_SECONDS:
        raise MessageError(f"stamp is '{stamp_ns}' ns, expected 0 to {MAX_SECONDS} s")
    return Time(sec=seconds, nanosec=nanoseconds)


def from_time(stamp: Time | cdr.Stamp) -> int:
    """Return the nanoseconds of a ROS stamp.

    Raises:
        MessageError: negative, or a second or more of nanoseconds.
    """
    if stamp.sec < 0 or stamp.nanosec >= NANOSECONDS:
        raise MessageError(f"stamp is '{stamp.sec}' s '{stamp.nanosec}' ns, expected seconds from 0 and nanoseconds below 10⁹")
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def header(stamp_ns: int, frame: str) -> Header:
    """Return a header."""
    return Header(stamp=to_time(stamp_ns), frame_id=frame)


def wire_header(stamp_ns: int, frame: str) -> cdr.Header:
    """Return the same for :mod:`vli_common.cdr`."""
    stamp = to_time(stamp_ns)
    return cdr.Header(cdr.Stamp(stamp.sec, stamp.nanosec), frame)


def image_to_cdr(image: Image) -> bytes:
    """Return ``image_long`` or ``image_short`` as it goes over the wire: rclpy would copy the pixels three times on the way."""
    height, width = image.pixels.shape[:2]
    encoding = "bgr8" if image.is_colour else "mono8"
    pixels = np.ascontiguousarray(image.pixels).reshape(-1)
    head = wire_header(image.stamp_ns, CAMERA_FRAME)
    return cdr.write_image(cdr.Image(head, height, width, encoding, False, width * _CHANNELS[encoding], pixels.data))


def image_from_message(message: ImageMessage | cdr.Image, session: int = 0, camera: CameraModel | None = None) -> Image:
    """Return the image of ``image_long`` or ``image_short``.

    Args:
        message: from a topic, not to be trusted.
        session: that the node is in.
        camera: that the image must be of the size of, where it is known.

    Raises:
        MessageError: another encoding, or sizes that do not fit the data, or the camera.
    """
    channels = _CHANNELS.get(message.encoding)
    if channels is None:
        raise MessageError(f"image has encoding '{message.encoding[:40]}', expected {' or '.join(_CHANNELS)}")
    width, height, step = message.width, message.height, message.step
    _check_image_size(message, channels)
    if camera is not None and (width, height) != (camera.width, camera.height):
        raise MessageError(f"image is '{width} x {height}', expected {camera.width} x {camera.height} as the calibration says")
    rows = np.frombuffer(message.data, np.uint8).reshape(height, step)[:, : width * channels]
    # A copy: kernels are compiled for arrays that can be written and have no gaps, for others it would be done on the spot.
    pixels = (rows.reshape(height, width, channels) if channels > 1 else rows).copy()
    return Image(from_time(message.header.stamp), pixels, session)


def encoded_to_cdr(image: EncodedImage) -> bytes:
    """Return ``/camera/image_raw`` or ``/camera/image_raw/compressed`` as it goes over the wire."""
    head = wire_header(image.stamp_ns, CAMERA_FRAME)
    if image.compressed:
        return cdr.write_compressed_image(cdr.CompressedImage(head, image.encoding, image.data))
    return cdr.write_image(cdr.Image(head, image.height, image.width, image.encoding, False, image.step, image.data))


def encoded_from_message(message: ImageMessage | CompressedImage | cdr.Image | cdr.CompressedImage) -> EncodedImage:
    """Return what the camera sent, in any encoding, undecoded.

    Raises:
        MessageError: no data, or sizes that do not fit the data.
    """
    stamp_ns = from_time(message.header.stamp)
    if isinstance(message, CompressedImage | cdr.CompressedImage):
        if not len(message.data):
            raise MessageError("compressed image has no data")
        return EncodedImage(stamp_ns, bytes(message.data), message.format, compressed=True)
    _check_image_size(message, 1)
    return EncodedImage(stamp_ns, bytes(message.data), message.encoding, message.width, message.height, message.step)


def exposure_to_message(image: EncodedImage) -> DiagnosticArray:
    """Return ``/camera/exposure`` of a frame; a key whose value is not known is left out."""
    values = []
    if image.exposure_s is not None:
        values.append(KeyValue(key="exposure_s", value=repr(image.exposure_s)))
    if image.laser_on is not None:
        values.append(KeyValue(key="laser", value="on" if image.laser_on else "off"))
    return DiagnosticArray(header=header(image.stamp_ns, CAMERA_FRAME), status=[DiagnosticStatus(name="exposure", values=values)])


def exposure_from_message(message: DiagnosticArray) -> tuple[int, float | None, bool | None]:
    """Return stamp, exposure in seconds and laser state of a frame, None where not told.

    Raises:
        MessageError: not one status, or a value that is no exposure or no laser state.
    """
    if len(message.status) != 1:
        raise MessageError(f"exposure has '{len(message.status)}' statuses, expected 1")
    values = {pair.key: pair.value for pair in message.status[0].values}
    laser = values.get("laser")
    if laser not in (None, "on", "off"):
        raise MessageError(f"exposure has laser '{laser[:40]}', expected on or off")
    try:
        exposure_s = float(values["exposure_s"]) if "exposure_s" in values else None
    except ValueError:
        exposure_s = -1.0
    if exposure_s is not None and not 0 < exposure_s < math.inf:
        raise MessageError(f"exposure has exposure_s '{values['exposure_s'][:40]}', expected seconds above 0")
    return from_time(message.header.stamp), exposure_s, None if laser is None else laser == "on"


def _check_image_size(message: ImageMessage | cdr.Image, bytes_per_pixel: int) -> None:
    width, height, step, size = message.width, message.height, message.step, len(message.data)
    if width < 1 or height < 1 or step < width * bytes_per_pixel or size != step * height:
        raise MessageError(f"image of '{width}' × '{height}' pixels in rows of '{step}' bytes does not fit its '{size}' bytes")


def session_to_message(session: Session) -> Header:
    """Return ``session``: frame_id is "N: reason"."""
    return header(session.stamp_ns, f"{session.number}: {session.reason}")


def session_from_message(message: Header) -> Session:
    """Return the session of a header "N: reason".

    Raises:
        MessageError: no number.
    """
    number, _, reason = message.frame_id.partition(":")
    if not (number.isascii() and number.isdigit() and len(number) < 10):
        raise MessageError(f"session is '{message.frame_id[:80]}', expected 'N: reason'")
    return Session(int(number), reason.strip(), from_time(message.stamp))


def status_to_message(status: StageStatus) -> DiagnosticArray:
    """Return ``status`` or ``/diagnostics``; the state is the first value."""
    values = {"state": status.state.value, **status.values}
    item = DiagnosticStatus(
        level=bytes([status.health.value]),
        name=status.node,
        message=status.hint or status.state.value,
        hardware_id="vli",
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )
    return DiagnosticArray(header=header(status.stamp_ns, ""), status=[item])


def status_from_message(message: DiagnosticArray) -> StageStatus:
    """Return the status of one node.

    Raises:
        MessageError: not exactly one status, or no known state or level.
    """
    if len(message.status) != 1:
        raise MessageError(f"status has '{len(message.status)}' entries, expected 1")
    (item,) = message.status
    values = {pair.key: pair.value for pair in item.values}
    try:
        health, state = Health(item.level[0]), NodeState(values.pop("state", ""))
    except ValueError as error:
        raise MessageError(f"status of '{item.name[:40]}': {str(error)[:80]}") from error
    hint = "" if item.message == state.value else item.message
    return StageStatus(from_time(message.header.stamp), item.name, health, state, hint, values)
