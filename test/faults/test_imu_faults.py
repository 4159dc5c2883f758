"""An IMU that is silent, scrambled, out of its mind, or on another clock."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from runs import map_in_truth, rmse_mm
from streams import Span, change, drop, duplicate, is_image, is_imu, shift, swap_with_next

from vli_common.geometry import transform
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


@pytest.mark.parametrize("lost_s", [0.3, 0.48, 0.6])
@pytest.mark.parametrize("begin_s", [1.7, pytest.param(2.5, marks=pytest.mark.slow)])
def test_f10_with_the_camera_gone_too_features_alone_find_the_place_or_it_is_lost(first_part, truth, scan, begin_s, lost_s):
    """Half a second without images, most of it without IMU: what a machine that hangs loses."""
    out = is_image(first_part) & Span(begin_s, begin_s + 0.6).mask(first_part)
    found = scan(drop(first_part, out | (is_imu(first_part) & Span(begin_s, begin_s + lost_s).mask(first_part))))
    assert np.all(_errors_mm(found, truth, begin_s) < np.maximum(3.0 * _sigmas_mm(found, begin_s), 0.2))
    if TrackingState.LOST not in found.states:
        assert _errors_mm(found, truth, begin_s)[-1] < 0.2


@pytest.mark.parametrize("begin_s", [1.7, pytest.param(3.3, marks=pytest.mark.slow)])
def test_f10_after_a_second_without_both_the_place_is_a_guess_that_says_how_far_it_errs(recording, truth, scan, begin_s):
    out = is_image(recording) & Span(begin_s, begin_s + 1.4).mask(recording)
    found = scan(drop(recording, out | (is_imu(recording) & Span(begin_s, begin_s + 0.48).mask(recording))))
    assert found.states == [TrackingState.INITIALISING, TrackingState.TRACKING, TrackingState.LOST, TrackingState.TRACKING]
    assert "the place in the map is a guess since the loss, to 50 mm: go back to a part that is mapped" in found.reasons[-1]
    assert np.all(_errors_mm(found, truth, begin_s) < 3.0 * _sigmas_mm(found, begin_s))
    assert rmse_mm(found.live(begin_s), truth) < 0.05


def _errors_mm(found, truth, since_s):
    """Return how far the poses since then are from the truth, aligned by those before."""
    T_truth_map, after = map_in_truth(found.live(end_s=since_s), truth), found.live(since_s)
    true = np.stack([truth(int(stamp))[:3, 3] for stamp in after.stamps_ns])
    return 1e3 * np.linalg.norm(transform(T_truth_map, after.positions) - true, axis=1)


def _sigmas_mm(found, since_s):
    poses = [output.pose for output in found.within(since_s) if output.pose is not None and output.state.has_pose]
    return 1e3 * np.sqrt([np.trace(pose.covariance[:3, :3]) for pose in poses])


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
    assert re.search(r"set cam0.timeshift_cam_imu to 0.01(4[89]|5[012])", front_end.hint)
    assert found.states == FINE
    assert rmse_mm(found.live(6.0), truth_of_revisit) < 0.1
