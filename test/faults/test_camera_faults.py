"""Images that are lost, late, dark, too bright or shaken."""

from __future__ import annotations

import numpy as np
import pytest
from runs import rmse_mm
from streams import Span, drop, duplicate, images, is_image, is_long, is_short, paint, shift, swap_with_next, until

from vli_bringup.tum import Trajectory
from vli_common.types import Exposure, TrackingState
from vli_driver.decode import decode
from vli_driver.demux import Demultiplexer

TRACKING, DEGRADED, LOST = TrackingState.TRACKING, TrackingState.DEGRADED, TrackingState.LOST


@pytest.fixture(scope="module")
def decoded(first_part):
    return [decode(image) for image in images(first_part)[:60]]


@pytest.mark.parametrize("dropped", range(30, 36))
@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("seen_in_stamps", [True, False], ids=["frames lost on the way", "triggers missed"])
def test_f1_after_a_lost_image_long_and_short_are_told_apart_within_two_frames(decoded, dropped, count, seen_in_stamps):
    """A frame lost on the way leaves a gap in the stamps; where a trigger is missed, the exposures just swap places."""
    left = [(index, image) for index, image in enumerate(decoded) if not dropped <= index < dropped + count]
    if not seen_in_stamps:
        left = [(index, shift(image, decoded[at].stamp_ns - image.stamp_ns)) for at, (index, image) in enumerate(left)]
    true = {image.stamp_ns: Exposure.SHORT if index % 2 else Exposure.LONG for index, image in left}
    demultiplexer = Demultiplexer()
    verdicts = {
        image.stamp_ns: exposure
        for ready in (*(demultiplexer.push(image) for _, image in left), demultiplexer.flush())
        for exposure, image in ready
    }
    assert not [stamp for stamp, exposure in verdicts.items() if exposure is Exposure.SHORT and true[stamp] is Exposure.LONG]
    locked = [stamp for stamp in list(true)[dropped + 2 :] if verdicts.get(stamp) is true[stamp]]
    assert len(locked) == len(true) - dropped - 2
    if seen_in_stamps:
        assert demultiplexer.counters["missing"] == count
    elif count % 2:
        assert demultiplexer.counters["phase_swap"] == 1


def test_f2_a_tenth_of_the_images_lost_is_tracked_throughout(recording, truth, clean, scan):
    lost = is_image(recording) & (np.random.default_rng(2).random(len(recording)) < 0.1)
    found = scan(drop(recording, lost))
    assert found.states == [TrackingState.INITIALISING, TRACKING]
    assert found.count("missing") == lost.sum()
    common = np.isin(clean.live().stamps_ns, found.live().stamps_ns)
    reference = Trajectory(clean.live().stamps_ns[common], clean.live().poses[common])
    # 0.01 mm: the clean error, 0.014 mm, is itself a matter of chance at this size.
    assert rmse_mm(found.live(), truth) < 1.5 * rmse_mm(reference, truth) + 0.01


def test_f3_without_camera_for_half_a_second_the_imu_carries_on(first_part, truth, scan):
    found = scan(drop(first_part, is_image(first_part) & Span(2.5, 3.0).mask(first_part)))
    assert found.states == [TrackingState.INITIALISING, TRACKING, DEGRADED, TRACKING]
    told = [output.reason for output in found.outputs if output.state is DEGRADED]
    assert all("the IMU carries it" in reason and "0.5 s" in reason for reason in told)
    assert found.count("missing") == 30
    assert rmse_mm(found.live(), truth) < 0.05


def test_f3_without_camera_for_three_seconds_it_is_lost_and_begins_anew(recording, truth, scan):
    found = scan(drop(recording, is_image(recording) & Span(2.5, 5.5).mask(recording)))
    assert found.states == [TrackingState.INITIALISING, TRACKING, LOST, TRACKING]
    assert any("too few features for 3.0 s" in reason for reason in found.reasons)
    back = next(output for output in found.within(5.5) if output.state is TRACKING)
    assert found.time_s(back) < 6.5
    assert "the place in the map is a guess since the loss" in found.reasons[-1]
    assert rmse_mm(found.live(end_s=2.5), truth) < 0.03
    assert rmse_mm(found.live(5.5), truth) < 0.05


def test_f6_a_flash_in_a_short_frame_is_rejected(first_part, truth, clean_first_part, scan):
    rng = np.random.default_rng(6)
    lit = is_short(first_part) & (rng.random(len(first_part)) < 0.2) & Span(1.0).mask(first_part)
    found = scan(paint(first_part, lit, lambda pixels: np.minimum(pixels.astype(np.int32) + 90, 255).astype(np.uint8)))
    assert found.states == clean_first_part.states
    assert found.count("ambient_light") == lit.sum()
    assert found.count("short_images") == clean_first_part.count("short_images") - lit.sum()
    assert rmse_mm(found.live(), truth) < 0.03


@pytest.mark.parametrize("gain", [2.0, pytest.param(0.5, marks=pytest.mark.slow)])
def test_f7_a_step_of_brightness_loses_few_tracks(first_part, truth, scan, gain):
    """In the six long frames after the step, of a hundred tracks."""
    before = until(first_part, 2.2)
    step = is_long(before) & Span(2.0).mask(before)
    found = scan(paint(before, step, lambda pixels: np.clip(gain * pixels, 0, 255).astype(np.uint8)))
    clean = scan(before)
    assert found.states == clean.states == [TrackingState.INITIALISING, TRACKING]
    lost = [result.count("tracks_lost") + result.count("tracks_rejected") for result in (clean, found)]
    assert lost[1] - lost[0] <= 20
    assert rmse_mm(found.live(), truth) < 0.03


def test_f8_a_covered_lens_is_lost_with_a_hint_and_back_within_a_second(recording, truth, scan):
    covered = is_image(recording) & Span(2.5, 5.5).mask(recording)
    found = scan(paint(recording, covered, lambda pixels: np.full_like(pixels, 1)))
    assert found.states == [TrackingState.INITIALISING, TRACKING, DEGRADED, LOST, TRACKING]
    assert "too few features for 1.0 s: covered lens, darkness or fast motion" in found.reasons
    back = next(output for output in found.within(5.5) if output.state is TRACKING)
    assert found.time_s(back) < 6.5
    assert rmse_mm(found.live(5.5), truth) < 0.05


def test_f12_images_out_of_order_or_twice_are_dropped_with_a_reason(first_part, truth, clean_first_part, scan):
    rng = np.random.default_rng(12)
    moving = is_image(first_part) & Span(1.0).mask(first_part)
    twice = duplicate(first_part, moving & (rng.random(len(first_part)) < 0.1))
    found = scan(twice)
    assert found.count("duplicate") == len(twice) - len(first_part)
    np.testing.assert_array_equal(found.live().poses, clean_first_part.live().poses)
    swapped = scan(swap_with_next(first_part, moving & (rng.random(len(first_part)) < 0.05)))
    assert swapped.count("out_of_order") > 5
    assert swapped.states == clean_first_part.states
    assert rmse_mm(swapped.live(), truth) < 1.5 * rmse_mm(clean_first_part.live(), truth)
