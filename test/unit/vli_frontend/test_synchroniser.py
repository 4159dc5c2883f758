"""Frames wait for the IMU, both stay in order, every drop is counted."""

from __future__ import annotations

import numpy as np
import pytest

from vli_common.types import Counters, ImuSample
from vli_frontend.photometry import Frame
from vli_frontend.synchroniser import ImuHistory, ReadyFrame, Synchroniser, Waiting

MS = 1_000_000


def sample(stamp_ns: int, value: float = 0.0) -> ImuSample:
    return ImuSample(stamp_ns, np.full(3, value), np.full(3, 10 * value))


def frame(stamp_ns: int) -> Frame:
    pixels = np.zeros((4, 4), np.uint8)
    return Frame(stamp_ns, pixels, pixels[::2, ::2], pixels[::2, ::2])


@pytest.fixture
def counters() -> Counters:
    return Counters()


@pytest.fixture
def synchroniser(counters: Counters) -> Synchroniser:
    return Synchroniser(0, 50 * MS, True, counters)


def covered_stamps(synchroniser: Synchroniser) -> list[tuple[int, bool]]:
    out = []
    while isinstance(ready := synchroniser.next(), ReadyFrame):
        out.append((ready.frame.stamp_ns, ready.covered))
    return out


def test_a_frame_goes_on_with_the_first_sample_at_or_after_its_stamp(synchroniser: Synchroniser) -> None:
    assert synchroniser.next() is Waiting.NO_FRAME
    synchroniser.add_frame(frame(100 * MS))
    assert synchroniser.next() is Waiting.NO_IMU
    synchroniser.add_imu(sample(99 * MS))
    assert synchroniser.next() is Waiting.IMU_BEHIND
    synchroniser.add_imu(sample(100 * MS))
    assert covered_stamps(synchroniser) == [(100 * MS, True)]


def test_the_time_shift_moves_the_frame_on_the_clock_of_the_imu(counters: Counters) -> None:
    synchroniser = Synchroniser(8 * MS, 50 * MS, True, counters)
    synchroniser.add_frame(frame(100 * MS))
    synchroniser.add_imu(sample(105 * MS))
    assert synchroniser.next() is Waiting.IMU_BEHIND
    synchroniser.add_imu(sample(110 * MS))
    assert covered_stamps(synchroniser) == [(100 * MS, True)]


def test_an_imu_that_runs_far_ahead_of_the_images_still_covers_them(synchroniser: Synchroniser, counters: Counters) -> None:
    for k in range(100):
        synchroniser.add_imu(sample(k * 5 * MS))
    synchroniser.add_frame(frame(101 * MS))
    assert covered_stamps(synchroniser) == [(101 * MS, True)]
    assert counters.values == {}


def test_without_the_imu_each_frame_goes_on_at_once(counters: Counters) -> None:
    synchroniser = Synchroniser(0, 50 * MS, False, counters)
    synchroniser.add_frame(frame(100 * MS))
    assert covered_stamps(synchroniser) == [(100 * MS, False)]


def test_a_frame_does_not_wait_longer_than_allowed_for_a_dead_imu(synchroniser: Synchroniser, counters: Counters) -> None:
    synchroniser.add_imu(sample(95 * MS))
    synchroniser.add_frame(frame(100 * MS))
    synchroniser.add_frame(frame(133 * MS))
    assert synchroniser.next() is Waiting.IMU_BEHIND
    synchroniser.add_frame(frame(167 * MS))
    assert covered_stamps(synchroniser) == [(100 * MS, False)]
    assert counters["frames_without_imu"] == 1


def test_a_sample_after_a_long_gap_does_not_count_as_cover(synchroniser: Synchroniser) -> None:
    synchroniser.add_imu(sample(95 * MS))
    synchroniser.add_frame(frame(100 * MS))
    synchroniser.add_imu(sample(151 * MS))
    assert covered_stamps(synchroniser) == [(100 * MS, False)]


def test_what_is_too_late_duplicated_or_not_finite_is_dropped_and_counted(synchroniser: Synchroniser, counters: Counters) -> None:
    assert synchroniser.add_imu(sample(10 * MS))
    assert not synchroniser.add_imu(sample(10 * MS))
    assert not synchroniser.add_imu(sample(5 * MS))
    assert not synchroniser.add_imu(sample(15 * MS, np.nan))
    assert not synchroniser.add_imu(sample(15 * MS, np.inf))
    assert synchroniser.add_frame(frame(10 * MS))
    assert not synchroniser.add_frame(frame(10 * MS))
    assert not synchroniser.add_frame(frame(9 * MS))
    assert counters.values == {
        "imu_duplicate": 1,
        "imu_too_late": 1,
        "imu_not_finite": 2,
        "frames_duplicate": 1,
        "frames_out_of_order": 1,
    }
    assert synchroniser.imu.newest_ns == 10 * MS


def test_a_late_sample_is_put_where_it_belongs(synchroniser: Synchroniser, counters: Counters) -> None:
    in_order, history = ImuHistory(), synchroniser.imu
    for k in range(60):
        in_order.append(sample(5 * k * MS, float(k)))
    for k in (0, 1, 3, 2, *range(5, 12), 4, *range(12, 60)):
        assert synchroniser.add_imu(sample(5 * k * MS, float(k)))
    assert counters.values == {"imu_out_of_order": 2}
    assert not synchroniser.add_imu(sample(0))
    assert counters["imu_too_late"] == 1
    expected, found = in_order.segment(3 * MS, 290 * MS), history.segment(3 * MS, 290 * MS)
    assert expected is not None
    assert found is not None
    np.testing.assert_array_equal(found.stamps, expected.stamps)
    np.testing.assert_array_equal(found.gyro, expected.gyro)


def test_a_frame_waits_for_the_sample_that_seems_to_be_missing_before_it(synchroniser: Synchroniser) -> None:
    for k in range(40):
        synchroniser.add_imu(sample(5 * k * MS))
    synchroniser.add_frame(frame(198 * MS))
    synchroniser.add_imu(sample(205 * MS))
    assert synchroniser.next() is Waiting.IMU_BEHIND
    synchroniser.add_imu(sample(200 * MS))
    assert covered_stamps(synchroniser) == [(198 * MS, True)]


def test_a_frame_does_not_wait_for_a_sample_that_is_lost(synchroniser: Synchroniser) -> None:
    for k in range(40):
        synchroniser.add_imu(sample(5 * k * MS))
    synchroniser.add_frame(frame(198 * MS))
    synchroniser.add_imu(sample(205 * MS))
    synchroniser.add_imu(sample(210 * MS))
    assert covered_stamps(synchroniser) == [(198 * MS, True)]


def test_late_samples_find_their_place_in_a_full_history() -> None:
    history = ImuHistory()
    for k in range(16_384):
        history.append(sample(10 * k * MS, float(k)))
    assert history.insert(sample(163_815 * MS, 0.5))
    segment = history.segment(163_810 * MS, 163_820 * MS)
    assert segment is not None
    np.testing.assert_allclose(segment.gyro[:, 0], [16_381, 0.5, 16_382])


def test_too_many_waiting_frames_lose_the_oldest(counters: Counters) -> None:
    synchroniser = Synchroniser(0, 10_000 * MS, True, counters)
    for k in range(40):
        synchroniser.add_frame(frame(k * MS))
    assert counters["frames_overrun"] == 8
    synchroniser.add_imu(sample(100 * MS))
    assert [stamp for stamp, _ in covered_stamps(synchroniser)] == [k * MS for k in range(8, 40)]


def test_a_segment_ends_at_the_stamps_asked_for_by_interpolation() -> None:
    history = ImuHistory()
    for k in range(5):
        history.append(sample(10 * k * MS, float(k)))
    segment = history.segment(5 * MS, 32 * MS)
    assert segment is not None
    assert segment.stamps.tolist() == [5 * MS, 10 * MS, 20 * MS, 30 * MS, 32 * MS]
    np.testing.assert_allclose(segment.gyro[:, 0], [0.5, 1, 2, 3, 3.2])
    np.testing.assert_allclose(segment.accel[:, 2], [5, 10, 20, 30, 32])
    np.testing.assert_allclose(segment.mean_rate, np.full(3, 1.85))
    assert segment.longest_gap_ns == 10 * MS


def test_a_segment_on_the_stamps_of_samples_takes_them_as_they_are() -> None:
    history = ImuHistory()
    for k in range(4):
        history.append(sample(10 * k * MS, float(k)))
    segment = history.segment(10 * MS, 30 * MS)
    assert segment is not None
    np.testing.assert_allclose(segment.gyro[:, 1], [1, 2, 3])


def test_a_segment_within_one_interval_has_two_ends_only() -> None:
    history = ImuHistory()
    history.append(sample(0, 0.0))
    history.append(sample(100 * MS, 1.0))
    segment = history.segment(20 * MS, 60 * MS)
    assert segment is not None
    np.testing.assert_allclose(segment.gyro[:, 0], [0.2, 0.6])
    assert segment.longest_gap_ns == 100 * MS


def test_there_is_no_segment_where_the_samples_do_not_reach() -> None:
    history = ImuHistory()
    assert history.segment(0, 10 * MS) is None
    for k in range(1, 4):
        history.append(sample(10 * k * MS))
    assert history.segment(5 * MS, 20 * MS) is None
    assert history.segment(15 * MS, 35 * MS) is None
    assert history.segment(20 * MS, 20 * MS) is None


def test_a_long_history_keeps_the_newest_samples_only() -> None:
    history = ImuHistory()
    for k in range(20_000):
        history.append(sample(k * MS, float(k)))
    segment = history.segment(19_990 * MS, 19_999 * MS)
    assert segment is not None
    np.testing.assert_allclose(segment.gyro[:, 0], np.arange(19_990, 20_000))
    assert history.segment(0, 10 * MS) is None
