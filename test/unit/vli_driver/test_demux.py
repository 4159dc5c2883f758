"""The demultiplexer against streams whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vli_common.types import Exposure, Image
from vli_driver.brightness import brightness
from vli_driver.demux import Demultiplexer

PERIOD_NS = 16_666_667
LONG, SHORT = Exposure.LONG, Exposure.SHORT
LEVEL = {LONG: 70, SHORT: 5}
Stream = list[tuple[Exposure, Image]]


def frame(k: int, exposure: Exposure, level: int | None = None, jitter_ns: int = 0) -> Image:
    """Return frame k: a flat image with noise, a short one with a saturated stripe."""
    rng = np.random.default_rng(k)
    base = LEVEL[exposure] if level is None else level
    pixels = np.clip(rng.normal(base, 2, (96, 128)), 0, 255).astype(np.uint8)
    if exposure is SHORT:
        pixels[45:49] = 255
    return Image(10**11 + k * PERIOD_NS + jitter_ns, pixels)


def stream(count: int = 200, first: Exposure = LONG) -> Stream:
    kinds = (first, SHORT if first is LONG else LONG)
    return [(kinds[k % 2], frame(k, kinds[k % 2])) for k in range(count)]


def sort(frames: Stream) -> tuple[Stream, Demultiplexer]:
    demultiplexer = Demultiplexer()
    out = [item for _, image in frames for item in demultiplexer.push(image)]
    return out + demultiplexer.flush(), demultiplexer


def wrong(out: Stream, frames: Stream) -> list[Exposure]:
    """Return what frames were taken for, those that were taken wrongly."""
    truth = {id(image): exposure for exposure, image in frames}
    return [exposure for exposure, image in out if truth[id(image)] is not exposure]


@pytest.mark.parametrize("first", [LONG, SHORT])
def test_an_alternating_stream_is_sorted_with_a_delay_of_a_few_frames(first: Exposure) -> None:
    frames = stream(first=first)
    demultiplexer = Demultiplexer()
    delays = [len(demultiplexer.push(image)) for _, image in frames[:6]]
    assert delays == [0, 0, 0, 4, 1, 1]
    out, _ = sort(frames)
    assert out == frames


@pytest.mark.parametrize("dropped", [1, 2, 3, 50, 51])
def test_after_one_lost_image_every_frame_is_still_right(dropped: int) -> None:
    frames = stream()
    del frames[dropped]
    out, demultiplexer = sort(frames)
    assert wrong(out, frames) == []
    assert len(out) == len(frames)
    # Before the second frame nobody knows the period.
    assert demultiplexer.counters["missing"] == (dropped > 1)


@pytest.mark.parametrize("slipped", [50, 51])
def test_when_long_and_short_swap_places_without_a_gap_the_rhythm_is_found_again(slipped: int) -> None:
    frames = stream()
    kept = frames[:slipped] + [
        (exposure, replace(image, stamp_ns=image.stamp_ns - PERIOD_NS)) for exposure, image in frames[slipped + 1 :]
    ]
    out, demultiplexer = sort(kept)
    assert wrong(out, kept) == []
    assert len(out) == len(kept)
    assert demultiplexer.counters["phase_swap"] == 1


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("rate", [0.1, 0.3])
def test_random_drops_never_make_a_stripe_of_a_long_frame(seed: int, rate: float) -> None:
    rng = np.random.default_rng(seed)
    frames = [item for item in stream(400) if rng.random() > rate]
    out, _ = sort(frames)
    assert SHORT not in wrong(out, frames)
    assert len(out) >= 0.97 * len(frames)
    if rate == 0.1:
        assert wrong(out, frames) == []


def test_jitter_and_uneven_mid_exposures_do_not_matter() -> None:
    rng = np.random.default_rng(0)
    frames = [
        (exposure, replace(image, stamp_ns=image.stamp_ns + int(rng.normal(0, 5e5)) + (2_350_000 if exposure is SHORT else 0)))
        for exposure, image in stream()
    ]
    del frames[77:80]
    out, demultiplexer = sort(frames)
    assert (wrong(out, frames), len(out)) == ([], len(frames))
    assert demultiplexer.counters["missing"] == 3


def test_a_flash_in_a_short_frame_costs_that_frame_only() -> None:
    frames = stream()
    for k in (51, 91, 93):
        frames[k] = (SHORT, frame(k, SHORT, level=60))
    out, demultiplexer = sort(frames)
    assert wrong(out, frames) == []
    assert [item for k, item in enumerate(frames) if k not in (51, 91, 93)] == out
    assert demultiplexer.counters["ambient_light"] == 3


@pytest.mark.parametrize("factor", [0.25, 0.5, 2.0, 3.5])
def test_a_brightness_step_of_the_long_frames_loses_none(factor: float) -> None:
    frames = [
        (exposure, frame(k, exposure, int(70 * factor)) if exposure is LONG and k > 80 else image)
        for k, (exposure, image) in enumerate(stream())
    ]
    out, _ = sort(frames)
    assert out == frames


def test_a_covered_lens_does_not_upset_what_comes_after() -> None:
    frames = [(exposure, frame(k, LONG, 0) if 60 <= k < 240 else image) for k, (exposure, image) in enumerate(stream(400))]
    out, demultiplexer = sort(frames)
    assert [item for item in out if item[1].stamp_ns >= frames[242][1].stamp_ns] == frames[242:]
    assert wrong(out, frames) == []
    assert demultiplexer.counters["dark_long"] >= 85


def test_after_a_long_gap_brightness_alone_finds_the_rhythm() -> None:
    frames = stream(100)
    later = [(exposure, replace(image, stamp_ns=image.stamp_ns + 3 * 10**9 + 11_000_000)) for exposure, image in frames[51:]]
    out, _ = sort(frames[:51] + later)
    assert out == frames[:51] + later


def test_duplicates_and_late_images_are_dropped_and_counted() -> None:
    frames = stream()
    shuffled = [*frames[:60], frames[61], frames[60], frames[61], *frames[62:]]
    out, demultiplexer = sort(shuffled)
    assert out == frames[:60] + frames[61:]
    assert (demultiplexer.counters["duplicate"], demultiplexer.counters["out_of_order"]) == (1, 1)


def test_a_clock_that_jumps_back_begins_anew() -> None:
    frames = stream(100)
    again = [(exposure, replace(image, stamp_ns=image.stamp_ns - 10**10)) for exposure, image in stream(101, SHORT)[1:]]
    out, demultiplexer = sort(frames + again)
    assert out == frames + again
    assert demultiplexer.counters["clock_jump"] == 1


@pytest.mark.parametrize(("is_told", "counted"), [(False, 1), (True, 0)])
def test_a_bag_in_a_loop_is_no_jump_of_the_clock_and_a_stream_that_is_told_to_begin_is_neither(
    is_told: bool, counted: int
) -> None:
    demultiplexer, frames = Demultiplexer(), stream(200)
    out = [item for _, image in frames for item in demultiplexer.push(image)]
    if is_told:
        out += demultiplexer.flush()
        demultiplexer.reset()
    out += [item for _, image in frames for item in demultiplexer.push(image)]
    assert out + demultiplexer.flush() == frames + frames
    assert (demultiplexer.counters["clock_jump"], demultiplexer.counters["played_again"]) == (0, counted)


def test_a_stream_that_does_not_alternate_is_all_long_after_two_seconds() -> None:
    frames = [(LONG, frame(k, LONG)) for k in range(200)]
    demultiplexer = Demultiplexer()
    ready = [len(demultiplexer.push(image)) for _, image in frames]
    assert ready[:120] == [0] * 120
    assert ready[120:] == [121] + [1] * 79
    assert demultiplexer.is_alternating is False


def test_a_short_recording_that_does_not_alternate_is_all_long() -> None:
    frames = [(LONG, frame(k, LONG)) for k in range(30)]
    assert sort(frames)[0] == frames


def test_a_laser_that_starts_late_is_noticed_within_a_second() -> None:
    frames = [(LONG, frame(k, LONG)) for k in range(150)] + stream(400)[150:]
    out, _ = sort(frames)
    assert wrong(out[:150], frames) == []
    assert wrong([item for item in out if item[1].stamp_ns >= frames[212][1].stamp_ns], frames) == []


def test_what_the_exposure_topic_says_is_believed() -> None:
    # So little contrast that brightness and rhythm would call it all long.
    frames = [
        (exposure, replace(frame(k, LONG, 60 + (exposure is LONG)), laser_on=exposure is SHORT))
        for k, (exposure, _) in enumerate(stream(60))
    ]
    del frames[20]
    assert sort(frames)[0] == frames


def test_a_flash_is_rejected_although_the_exposure_is_known() -> None:
    frames = [(exposure, replace(image, laser_on=exposure is SHORT)) for exposure, image in stream(60)]
    frames[31] = (SHORT, replace(frame(31, SHORT, 65), laser_on=True))
    out, demultiplexer = sort(frames)
    assert out == frames[:31] + frames[32:]
    assert demultiplexer.counters["ambient_light"] == 1


def test_brightness_does_not_see_the_stripe() -> None:
    assert brightness(frame(1, SHORT).pixels) == pytest.approx(5, abs=0.6)
    assert brightness(np.full((40, 40, 3), 90, np.uint8)) == 90
    assert brightness(np.zeros((3, 3), np.uint8)) == 0
