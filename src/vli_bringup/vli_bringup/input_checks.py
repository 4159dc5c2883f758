"""What can be told of a bag before it is run: sizes, clocks, units. Each finding is one line that says what to do."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from vli_common.arrays import ByteArray, FloatArray, IntArray
from vli_common.calibration import Calibration
from vli_common.errors import InputError
from vli_common.types import NANOSECONDS, ImuSample
from vli_driver.bag import BagReader
from vli_driver.decode import decode

_SPAN_NS = 20 * NANOSECONDS
_GRAVITY = 9.80665
_INTRINSICS_TOLERANCE = 0.01
_TRIED_IMAGES = 30


@dataclass(frozen=True, slots=True)
class Beginning:
    """The first seconds of a bag: image stamps (N,), IMU stamps (M,) in ns, gyro (M, 3) and accel (M, 3) as recorded."""

    image_stamps: IntArray
    imu_stamps: IntArray
    gyro: FloatArray
    accel: FloatArray


def check_input(reader: BagReader, calibration: Calibration, uses_imu: bool) -> list[str]:
    """Check a bag against its calibration; return warnings.

    Args:
        reader: of the whole bag; only its first 20 s are read.
        calibration: that the bag is to be run with.
        uses_imu: False where the IMU takes no part.

    Raises:
        InputError: no images, an image size that is not the calibration's, an IMU on another clock or in other units.
    """
    _check_image_size(reader, calibration)
    if uses_imu:
        beginning = read_beginning(reader)
        check_overlap(beginning, reader.imu_topic or "")
        check_accelerometer_unit(beginning.accel)
        check_gyro_unit(beginning)
    return _camera_info_warnings(reader.camera_info(), calibration)


def read_beginning(reader: BagReader) -> Beginning:
    """Read the first 20 s, by the stamps of the images."""
    images: list[int] = []
    samples: list[ImuSample] = []
    for item in reader:
        if isinstance(item, ImuSample):
            samples.append(item)
            continue
        images.append(item.stamp_ns)
        if item.stamp_ns - images[0] > _SPAN_NS:
            break
    return Beginning(
        np.array(images, dtype=np.int64),
        np.array([sample.stamp_ns for sample in samples], dtype=np.int64),
        np.array([sample.gyro for sample in samples]).reshape(-1, 3),
        np.array([sample.accel for sample in samples]).reshape(-1, 3),
    )


def check_overlap(beginning: Beginning, topic: str) -> None:
    """Raise where no IMU sample lies between the earliest and the latest image."""
    images, samples = beginning.image_stamps, beginning.imu_stamps
    if not len(images):
        raise InputError("no image could be read from the bag; see what it holds with: ros2 bag info")
    if len(samples) and not samples.any():
        raise InputError(f"IMU samples on '{topic}' are stamped '0'; expected the time of measurement in header.stamp")
    # Not the first and the last: a clock that was set is no reason to refuse a bag.
    inside = (samples >= images.min()) & (samples <= images.max())
    if not inside.any():
        there = f"IMU samples are stamped '{_span(samples)}'" if len(samples) else "there are no IMU samples"
        raise InputError(
            f"no IMU sample on '{topic}' lies between the images: {there}, images '{_span(images)}'; "
            "stamp both by one clock, or run without the IMU: --mode vl"
        )


def check_accelerometer_unit(accel: FloatArray) -> None:
    """Raise where the specific force (M, 3) is no gravity in m/s²: its median tells, since a hand hardly accelerates."""
    norm = float(np.median(np.linalg.norm(accel, axis=1)))
    if 0.5 * _GRAVITY < norm < 1.5 * _GRAVITY:
        return
    if 0.5 < norm < 1.5:
        unit = f"that is g, multiply linear_acceleration by {_GRAVITY}"
    elif 0.5 < norm / (1e3 * _GRAVITY) < 1.5 or 0.5 < norm / 1e3 < 1.5:
        unit = "that looks like mm/s² or milli-g, convert linear_acceleration"
    else:
        unit = "is gravity taken out? linear_acceleration must hold what the accelerometer measures"
    raise InputError(f"the IMU measures '{norm:.3g}' m/s² in the median, expected about {_GRAVITY:.1f} m/s²: {unit}")


def check_gyro_unit(beginning: Beginning) -> None:
    """Raise where the gyro turns 57 times faster than gravity does in its frame: deg/s for rad/s."""
    scale, sigma = gravity_rate_scale(beginning.imu_stamps, beginning.gyro, beginning.accel)
    if scale - 4 * sigma > 0 and scale + 4 * sigma < 0.1:
        raise InputError(
            f"the gyro reads '{1 / scale:.0f}' times the rate at which gravity turns in its frame, expected 1: that is deg/s, "
            "convert angular_velocity to rad/s"
        )


def gravity_rate_scale(stamps: IntArray, gyro: FloatArray, accel: FloatArray, window_s: float = 0.25) -> tuple[float, float]:
    """Return s and its sigma in du/dt = −s (ω − b) × u, u the direction of gravity, b a constant bias.

    Least squares over means of ``window_s``; (1, inf) where there is too little to tell.

    Args:
        stamps: (M,) ns.
        gyro: (M, 3).
        accel: (M, 3), its unit does not matter.
        window_s: seconds; hand tremor averages out within it.
    """
    unknown = (1.0, float("inf"))
    period_s = float(np.median(np.diff(stamps))) / NANOSECONDS if len(stamps) > 1 else 0.0
    length = round(window_s / period_s) if period_s > 0 else 0
    count = len(stamps) // length if length > 1 else 0
    if count < 8:
        return unknown
    means = accel[: count * length].reshape(count, length, 3).mean(axis=1)
    directions = means / np.linalg.norm(means, axis=1, keepdims=True)
    half = length // 2
    rates = gyro[half : half + (count - 1) * length].reshape(count - 1, length, 3).mean(axis=1)
    between = 0.5 * (directions[1:] + directions[:-1])
    step_s = length * period_s
    columns = [-np.cross(rates, between), *(np.cross(axis, between) for axis in np.eye(3))]
    design = step_s * np.stack([column.ravel() for column in columns], axis=1)
    change = (directions[1:] - directions[:-1]).ravel()
    solution, _, rank, _ = np.linalg.lstsq(design, change, rcond=None)
    if rank < design.shape[1]:
        return unknown
    variance = float(np.var(change - design @ solution))
    return float(solution[0]), float(np.sqrt(variance * np.linalg.inv(design.T @ design)[0, 0]))


def check_part(reader: BagReader) -> None:
    """Raise where the part of a bag that is asked for has no image."""
    if next(reader.images(), None) is None:
        start_ns, end_ns = reader.time_range_ns
        raise InputError(
            f"the part of '{reader.path}' that is asked for holds no image, the bag has "
            f"'{(end_ns - start_ns) / NANOSECONDS:.1f}' s; choose another with --start and --duration"
        )


def _check_image_size(reader: BagReader, calibration: Calibration) -> None:
    height, width = _first_pixels(reader).shape[:2]
    camera = calibration.camera
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f"images on '{reader.image_topic}' are '{width} x {height}', the calibration is for "
            f"{camera.width} x {camera.height}; calibrate the camera at this resolution"
        )


def _first_pixels(reader: BagReader) -> ByteArray:
    """Return the first image that can be decoded; one that cannot does not speak against the others."""
    problem = InputError(f"topic '{reader.image_topic}' in '{reader.path}' holds no image; see what there is with: ros2 bag info")
    for image in itertools.islice(reader.images(), _TRIED_IMAGES):
        try:
            return decode(image).pixels
        except InputError as error:
            problem = error
    raise problem


def _camera_info_warnings(info: Any, calibration: Calibration) -> list[str]:
    """Compare the intrinsics of a camera_info message, where it has any, with the calibration's."""
    if info is None or not np.any(info.k):
        return []
    fx, cx, fy, cy = (float(info.k[index]) for index in (0, 2, 4, 5))
    camera = calibration.camera
    named = {"fx": (fx, camera.fx), "fy": (fy, camera.fy), "cx": (cx, camera.cx), "cy": (cy, camera.cy)}
    off = [f"{name} {there:.1f} for {ours:.1f}" for name, (there, ours) in named.items() if _differ(there, ours)]
    return [f"camera_info differs from the calibration, which is used: {', '.join(off)}"] if off else []


def _differ(there: float, ours: float) -> bool:
    return abs(there - ours) > _INTRINSICS_TOLERANCE * abs(ours)


def _span(stamps: IntArray) -> str:
    return f"{stamps.min() / NANOSECONDS:.3f} to {stamps.max() / NANOSECONDS:.3f} s"
