"""Units and clocks are told from the first seconds of a bag."""

from __future__ import annotations

import numpy as np
import pytest

from vli_bringup.input_checks import (
    Beginning,
    check_accelerometer_unit,
    check_gyro_unit,
    check_overlap,
    gravity_rate_scale,
)
from vli_common.errors import InputError
from vli_common.geometry import so3_exp

RATE_HZ = 200


def swinging(seconds=20.0, amplitude=0.15, start_s=100.0, seed=3):
    """Return the beginning of a bag in which a hand tilts the IMU to and fro, with noise, bias and acceleration."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    angle = amplitude * np.stack([np.sin(0.9 * t), np.sin(1.4 * t + 1), np.sin(0.5 * t)], axis=1)
    rotations = so3_exp(angle)
    relative = np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:]
    rate = np.stack([relative[:, 2, 1], relative[:, 0, 2], relative[:, 1, 0]], axis=1) * RATE_HZ
    gyro = np.concatenate([rate, rate[-1:]]) + [0.01, -0.02, 0.005] + 5e-3 * rng.standard_normal((len(t), 3))
    accel = np.swapaxes(rotations, 1, 2) @ [0, 0, 9.81] + 0.2 * rng.standard_normal((len(t), 3))
    stamps = np.round((start_s + t) * 1e9).astype(np.int64)
    return Beginning(stamps[::7], stamps, gyro, accel)


@pytest.mark.parametrize("seed", range(4))
def test_radians_pass_and_degrees_are_named(seed):
    beginning = swinging(seed=seed)
    check_gyro_unit(beginning)
    degrees = Beginning(beginning.image_stamps, beginning.imu_stamps, np.degrees(beginning.gyro), beginning.accel)
    with pytest.raises(InputError, match=r"gyro reads '5\d' times .* that is deg/s, convert angular_velocity to rad/s"):
        check_gyro_unit(degrees)


def test_the_scale_of_a_clean_gyro_is_one():
    scale, sigma = gravity_rate_scale(*(getattr(swinging(), name) for name in ("imu_stamps", "gyro", "accel")))
    assert abs(scale - 1) < max(5 * sigma, 0.05)


def test_the_recording_passes_and_its_gyro_in_degrees_does_not(shared_data):
    from vli_bringup.input_checks import read_beginning
    from vli_driver.bag import BagReader

    beginning = read_beginning(BagReader(shared_data / "keyboard_short" / "bag"))
    check_overlap(beginning, "/imu")
    check_accelerometer_unit(beginning.accel)
    check_gyro_unit(beginning)
    with pytest.raises(InputError, match="deg/s"):
        check_gyro_unit(Beginning(beginning.image_stamps, beginning.imu_stamps, np.degrees(beginning.gyro), beginning.accel))


def test_an_imu_at_rest_says_nothing_of_the_gyro():
    rest = swinging(amplitude=0.0)
    for gyro in (rest.gyro, np.degrees(rest.gyro)):
        check_gyro_unit(Beginning(rest.image_stamps, rest.imu_stamps, gyro, rest.accel))


def test_too_short_a_beginning_says_nothing():
    assert gravity_rate_scale(np.arange(5) * 5_000_000, np.zeros((5, 3)), np.ones((5, 3))) == (1.0, np.inf)
    assert gravity_rate_scale(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))[1] == np.inf


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (1 / 9.80665, "'0.999' m/s².*that is g, multiply linear_acceleration by 9.80665"),
        (1e3, "mm/s² or milli-g"),
        (1e3 / 9.80665, "mm/s² or milli-g"),
        (0.0, "is gravity taken out"),
    ],
)
def test_an_acceleration_in_another_unit_is_named(factor, said):
    with pytest.raises(InputError, match=said):
        check_accelerometer_unit(factor * np.tile([0.1, 0.0, 9.8], (50, 1)))


def test_gravity_in_metres_passes():
    check_accelerometer_unit(np.tile([0.1, 0.0, 9.7], (50, 1)))


def test_an_imu_on_another_clock_is_named_with_both_spans():
    beginning = swinging()
    other = Beginning(beginning.image_stamps + 10**18, beginning.imu_stamps, beginning.gyro, beginning.accel)
    with pytest.raises(InputError, match=r"'/imu0' lies between the images: .*'100.000 to 119.995 s', images '1000000100.000 to"):
        check_overlap(other, "/imu0")


def test_imu_stamps_of_zero_are_named():
    beginning = swinging()
    zeros = Beginning(beginning.image_stamps, np.zeros_like(beginning.imu_stamps), beginning.gyro, beginning.accel)
    with pytest.raises(InputError, match="IMU samples on '/imu' are stamped '0'"):
        check_overlap(zeros, "/imu")


def test_a_silent_imu_is_named():
    silent = Beginning(np.array([1, 2]), np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))
    with pytest.raises(InputError, match="there are no IMU samples"):
        check_overlap(silent, "/imu")
