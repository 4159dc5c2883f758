"""The cost of an image is found with the long frame that it belongs to."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from vli_bringup import timing
from vli_bringup.timing import STAGES, FrameTimer


@pytest.fixture
def spend(monkeypatch):
    """Return a function that lets time pass."""
    now = [0.0]
    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])

    def advance(milliseconds):
        now[0] += 1e-3 * milliseconds

    return advance


def column(timer, stage):
    return timer.milliseconds()[:, STAGES.index(stage)]


def test_a_short_frame_and_the_imu_count_to_the_long_frame_before(spend):
    timer = FrameTimer()
    for stamp, is_long, decoding in ((10, True, 5), (20, False, 3), (30, True, 7)):
        timer.sorted_in(stamp, is_long, {"decode": 1e-3 * decoding})
        with timer.charge("frontend"):
            spend(1)
    np.testing.assert_allclose(column(timer, "decode"), [8, 7])
    np.testing.assert_allclose(column(timer, "frontend"), [2, 1])


def test_the_wait_for_an_image_counts_to_the_frame_it_belongs_to(spend):
    timer = FrameTimer()
    for stamp, is_long, wait in ((10, True, 5), (20, False, 3), (30, True, 7)):
        timer.start()
        spend(wait)
        timer.sorted_in(stamp, is_long, {})
        timer.lap()
        spend(100)
    np.testing.assert_allclose(timer.milliseconds()[:, -1], [8, 7])
    assert timer.summary()["ms_per_frame_mean"] == pytest.approx(7.5)


def test_wall_time_is_counted_once_where_two_threads_work(spend):
    timer = FrameTimer()
    timer.start()
    timer.sorted_in(10, True, {"decode": 4e-3, "stripe": 1e-3})
    with timer.charge("frontend"):
        spend(6)
    timer.lap()
    assert timer.summary() == {"ms_per_frame_mean": pytest.approx(6), "ms_per_frame_p95": pytest.approx(6)}


def test_what_comes_before_the_first_long_frame_counts_to_it(spend):
    timer = FrameTimer()
    timer.start()
    with timer.charge("frontend"):
        spend(4)
    timer.lap()
    timer.sorted_in(10, True, {})
    np.testing.assert_allclose(timer.milliseconds()[:, -1], 4)


def test_the_file_has_a_row_a_frame_and_its_stamp_to_the_nanosecond(spend, tmp_path):
    timer = FrameTimer()
    timer.start()
    timer.sorted_in(1_700_000_000_123_456_789, True, {})
    with timer.charge("backend"):
        spend(2)
    with timer.charge("mapping"):
        spend(1)
    timer.lap()
    timer.write(tmp_path / "timing.csv")
    rows = list(csv.DictReader((tmp_path / "timing.csv").open()))
    assert len(rows) == 1
    assert rows[0]["stamp"] == "1700000000.123456789"
    assert (rows[0]["backend_ms"], rows[0]["mapping_ms"], rows[0]["total_ms"]) == ("2.000", "1.000", "3.000")


def test_without_frames_there_is_no_figure():
    assert FrameTimer().summary() == {"ms_per_frame_mean": None, "ms_per_frame_p95": None}
