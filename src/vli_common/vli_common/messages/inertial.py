"""IMU samples, biases and GTSAM's preintegration ⇄ ROS messages.

A preintegration crosses the topic as GTSAM's own text archive. An archive says how much to allocate and which classes to make, so
before GTSAM sees it, its skeleton (every token that is no floating-point number) is compared with that of an archive made here,
its numbers are checked to be such as preintegrating leads to (covariances positive definite, gravity that of the Earth), and its
checksum and time span to be right. Never a pickle.
"""

from __future__ import annotations

import functools
import math
import re
import zlib

import gtsam
import numpy as np
from geometry_msgs.msg import TwistStamped
from sensor_msgs.msg import Imu, PointCloud2

from vli_common import cdr
from vli_common.arrays import FloatArray
from vli_common.errors import MessageError
from vli_common.frame_pairing import NoPreintegration
from vli_common.messages.basics import from_time, header, wire_header
from vli_common.messages.limits import LARGEST, checked
from vli_common.messages.pointcloud import cloud_from_rows, cloud_session, field_count, rows_from_cloud
from vli_common.messages.poses import from_vector, to_vector
from vli_common.topics import IMU_FRAME, preintegration_fields
from vli_common.types import NANOSECONDS, ImuBias, ImuSample, Preintegration

_MAX_ARCHIVE_BYTES = 65536
_MAX_SPAN_S = 60.0
_MAX_BIAS = 100.0
_GRAVITY_RANGE = (9.7, 9.9)
_SYMMETRY = 1e-6
_PARTS = {
    "gyroscope covariance": 9,
    "accelerometer covariance": 9,
    "integration covariance": 9,
    "gravity": 3,
    "walk of the accelerometer's bias": 9,
    "walk of the gyroscope's bias": 9,
    "bias": 6,
    "span": 1,
    "increments": 9,
    "derivatives": 54,
    "covariance": 225,
}
"""Numbers of an archive, in their order: parameters, then what was measured with them."""
_COVARIANCES = [name for name in _PARTS if name.startswith("walk") or name.endswith("covariance")]
_SPAN_TOLERANCE_S = 1e-6
_NUMBER = re.compile(r"(-?[0-9]\.[0-9]+e[+-][0-9]+)")
"""One group: splitting leaves the skeleton at the even places, the numbers at the odd ones."""


def imu_to_cdr(sample: ImuSample) -> bytes:
    """Return ``/imu`` as it goes over the wire; the orientation is marked as absent."""
    return cdr.write_imu(wire_header(sample.stamp_ns, IMU_FRAME), sample.gyro, sample.accel)


def imu_from_message(message: Imu | cdr.Imu) -> ImuSample:
    """Return one sample.

    Raises:
        MessageError: not finite, or marked as holding no angular rate or no acceleration.
    """
    if message.angular_velocity_covariance[0] == cdr.NO_DATA or message.linear_acceleration_covariance[0] == cdr.NO_DATA:
        raise MessageError("IMU message says that it holds no angular rate or no acceleration (covariance '-1')")
    return ImuSample(
        from_time(message.header.stamp), from_vector(message.angular_velocity), from_vector(message.linear_acceleration)
    )


def bias_to_message(bias: ImuBias) -> TwistStamped:
    """Return ``bias``: angular is the gyro's, linear the accelerometer's."""
    message = TwistStamped(header=header(bias.stamp_ns, IMU_FRAME))
    message.twist.angular, message.twist.linear = to_vector(bias.gyro), to_vector(bias.accel)
    return message


def bias_from_message(message: TwistStamped, session: int = 0) -> ImuBias:
    """Return a bias.

    Raises:
        MessageError: not finite.
    """
    gyro, accel = from_vector(message.twist.angular), from_vector(message.twist.linear)
    return ImuBias(from_time(message.header.stamp), gyro, accel, session)


def preintegration_to_message(preintegration: Preintegration) -> PointCloud2:
    """Return ``preintegration``: one row whose ``data`` is the archive.

    Raises:
        MessageError: the archive is of a form that no reader would take (sensor pose or Coriolis terms in the parameters).
    """
    text: str = preintegration.measurements.serialize()  # type: ignore[attr-defined]
    _check_archive(text)
    data = text.encode("ascii")
    row = np.zeros(1, preintegration_fields(len(data)))
    row["from_sec"], row["from_nanosec"] = divmod(preintegration.from_ns, NANOSECONDS)
    # Inflated a million times, it says nothing any more.
    row["inflate"] = min(preintegration.inflate, LARGEST)
    row["crc32"], row["data"] = zlib.crc32(data), np.frombuffer(data, np.uint8)
    return cloud_from_rows(row, header(preintegration.stamp_ns, IMU_FRAME), preintegration.session)


def no_preintegration_message(stamp_ns: int, session: int) -> PointCloud2:
    """Return ``preintegration`` of a frame that has none (the first one, or a mode without IMU): no rows."""
    return cloud_from_rows(np.zeros(0, preintegration_fields(1)), header(stamp_ns, IMU_FRAME), session)


def preintegration_from_message(message: PointCloud2) -> Preintegration | NoPreintegration:
    """Return a preintegration that is safe to use, or the note that there is none.

    Raises:
        MessageError: malformed, wrong checksum, not finite, or a time span that is not the interval it is sent for.
    """
    if message.width * message.height == 0:
        rows = rows_from_cloud(message, preintegration_fields(1))
        return NoPreintegration(from_time(message.header.stamp), cloud_session(message, rows))
    size = field_count(message, "data")
    if not 0 < size <= _MAX_ARCHIVE_BYTES:
        raise MessageError(f"preintegration has '{size}' bytes of data, expected 1 to {_MAX_ARCHIVE_BYTES}")
    rows = rows_from_cloud(message, preintegration_fields(size))
    if len(rows) != 1:
        raise MessageError(f"preintegration has '{len(rows)}' rows, expected 1")
    row = rows[0]
    data = row["data"].tobytes()
    if zlib.crc32(data) != row["crc32"]:
        raise MessageError(f"preintegration has checksum '{zlib.crc32(data):08x}', expected '{int(row['crc32']):08x}'")
    if not row["inflate"] >= 1.0:
        raise MessageError(f"preintegration has inflate '{row['inflate']}', expected at least 1")
    stamp_ns, from_ns = from_time(message.header.stamp), int(row["from_sec"]) * NANOSECONDS + int(row["from_nanosec"])
    measurements = _measurements(data)
    span_s, expected_s = measurements.deltaTij(), (stamp_ns - from_ns) / NANOSECONDS
    if not 0 < expected_s <= _MAX_SPAN_S or not math.isclose(span_s, expected_s, rel_tol=0.0, abs_tol=_SPAN_TOLERANCE_S):
        raise MessageError(f"preintegration spans '{span_s}' s, its stamps '{expected_s}' s")
    return Preintegration(stamp_ns, from_ns, measurements, float(row["inflate"]), cloud_session(message, rows))


def _measurements(data: bytes) -> gtsam.PreintegratedCombinedMeasurements:
    try:
        text = data.decode("ascii")
        _check_archive(text)
        measurements = gtsam.PreintegratedCombinedMeasurements(gtsam.PreintegrationCombinedParams.MakeSharedU(0.0))
        measurements.deserialize(text)
    except (UnicodeDecodeError, RuntimeError) as error:
        raise MessageError(f"preintegration is no archive of this GTSAM: {error}") from error
    return measurements


def _check_archive(text: str) -> None:
    """Raise where an archive is not of the form, or its numbers are not of the size, that preintegrating leads to."""
    tokens = _NUMBER.split(text)
    if tokens[::2] != _reference_skeleton():
        raise MessageError("preintegration has an archive of another form (other GTSAM version, or values that are not finite)")
    numbers = np.array([float(token) for token in tokens[1::2]])
    if len(numbers) != sum(_PARTS.values()):
        raise MessageError(f"preintegration has '{len(numbers)}' numbers, expected {sum(_PARTS.values())}: another GTSAM version")
    parts = dict(zip(_PARTS, np.split(numbers, np.cumsum(list(_PARTS.values()))[:-1]), strict=True))
    checked(numbers, "preintegration")
    for name in _COVARIANCES:
        _check_covariance(name, parts[name])
    gravity = float(np.linalg.norm(parts["gravity"]))
    if not _GRAVITY_RANGE[0] <= gravity <= _GRAVITY_RANGE[1]:
        raise MessageError(
            f"preintegration has a gravity of '{gravity}' m/s², expected {_GRAVITY_RANGE[0]} to {_GRAVITY_RANGE[1]}"
        )
    if np.abs(parts["bias"]).max() > _MAX_BIAS:
        raise MessageError(f"preintegration has the bias '{parts['bias'].tolist()}', expected at most {_MAX_BIAS}")


def _check_covariance(name: str, values: FloatArray) -> None:
    side = math.isqrt(len(values))
    matrix = values.reshape(side, side)
    scale = float(np.abs(matrix).max())
    if scale == 0 or np.abs(matrix - matrix.T).max() > _SYMMETRY * scale:
        raise MessageError(f"preintegration has the {name} of nothing, or one that is not symmetric")
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise MessageError(f"preintegration has a {name} that is not positive definite") from None


@functools.lru_cache(maxsize=1)
def _reference_skeleton() -> list[str]:
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
    text: str = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias()).serialize()
    return _NUMBER.split(text)[::2]
