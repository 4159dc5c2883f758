"""An IMU that is silent, scrambled, out of its mind, or on another clock."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runs import rmse_mm
from streams import Span, change, drop, duplicate, is_imu, shift, swap_with_next

from vli_common.types import TrackingState

FINE = [TrackingState.INITIALISING, TrackingState.TRACKING]
MS = 1_000_000


@pytest.mark.parametrize("value", [np.nan, pytest.param(np.inf, marks=pytest.mark.slow)])
def test_f9_a_tenth_of_a_second_that_is_no_number_is_dropped_and_carried_by_the_rest(first_part, truth, scan, value):
    broken = is_imu(first_part) & Span(2.5, 2.6).mask(first_part)
    assert broken.sum() == 20
    found = scan(change(first_part, broken, lambda sample: replace(sample, accel=sample.accel * value)))
    assert found.states == FINE
    assert found.count("imu_not_finite") == 20
    assert rmse_mm(found.live(), truth) < 0.03


def test_f9_an_imu_that_goes_on_so_leaves_vision_and_laser(first_part, truth, scan):
    broken = is_imu(first_part) & Span(2.5).mask(first_part)
    found = scan(change(first_part, broken, lambda sample: replace(sample, gyro=sample.gyro * np.nan)))
    assert found.states == FINE
    assert found.count("imu_not_finite") == broken.sum()
    assert found.reasons[-1] == "no IMU for 1.4 s: vision carries on without it"
    assert rmse_mm(found.live(), truth) < 0.03


@pytest.mark.parametrize("gap_s", [0.05, 0.3])
@pytest.mark.parametrize("begin_s", [2.11, pytest.param(1.8, marks=pytest.mark.slow)])
def test_f10_across_a_gap_the_imu_is_interpolated_and_trusted_the_less(first_part, truth, scan, gap_s, begin_s):
    found = scan(drop(first_part, is_imu(first_part) & Span(begin_s, begin_s + gap_s).mask(first_part)))
    assert found.states == FINE
    assert found.count("intervals_inflated") > 0
    assert rmse_mm(found.live(), truth) < 0.03


def test_f10_after_two_seconds_without_imu_it_takes_part_again(recording, truth, scan):
    found = scan(drop(recording, is_imu(recording) & Span(2.5, 4.5).mask(recording)))
    assert found.states == FINE
    assert found.count("intervals_without_imu") > 0
    assert "no IMU for 1.9 s: vision carries on without it" in found.reasons
    assert found.reasons[-1] == ""
    assert rmse_mm(found.live(), truth) < 0.03


def test_f11_imu_samples_out_of_order_or_twice_come_to_the_same_as_sorted(first_part, clean_first_part, scan):
    rng = np.random.default_rng(11)
    some = is_imu(first_part) & Span(1.0).mask(first_part) & (rng.random(len(first_part)) < 0.05)
    twice = scan(duplicate(first_part, some))
    assert twice.count("imu_duplicate") == some.sum()
    np.testing.assert_array_equal(twice.live().poses, clean_first_part.live().poses)
    swapped = scan(swap_with_next(first_part, some))
    assert swapped.count("imu_out_of_order") > 0.8 * some.sum()
    assert swapped.count("imu_too_late") == 0
    np.testing.assert_allclose(swapped.live().positions, clean_first_part.live().positions, atol=5e-6)


@pytest.mark.slow
def test_f14_a_camera_clock_that_is_off_is_found_and_told(revisit, truth_of_revisit, scan):
    found = scan(change(revisit, is_imu(revisit), lambda sample: shift(sample, 15 * MS)))
    front_end = found.pipeline.stages.front_end
    assert front_end.timeshift_ns == pytest.approx(15 * MS, abs=2 * MS)
    assert "set cam0.timeshift_cam_imu to 0.015" in front_end.hint
    assert found.states == FINE
    assert rmse_mm(found.live(6.0), truth_of_revisit) < 0.1
