"""From the moment a frame is due until its pose is there."""

from __future__ import annotations

from pathlib import Path

from vli_bringup.latency import FrameLatencies

MS = 1_000_000
SECOND = 1000 * MS
WALL = 1_800_000_000 * SECOND


def test_frames_of_a_bag_are_due_in_proportion_to_the_rate() -> None:
    latencies = FrameLatencies(rate=0.5)
    latencies.add_due(100 * SECOND, WALL)
    latencies.add_pose(100 * SECOND, WALL + 20 * MS)
    latencies.add_pose(101 * SECOND, WALL + 2 * SECOND + 30 * MS)
    assert latencies.milliseconds() == {100 * SECOND: 20.0, 101 * SECOND: 30.0}


def test_after_a_pause_frames_are_due_anew() -> None:
    latencies = FrameLatencies()
    latencies.add_due(100 * SECOND, WALL)
    latencies.add_due(105 * SECOND, WALL + 60 * SECOND)
    latencies.add_pose(104 * SECOND, WALL + 4 * SECOND + 5 * MS)
    latencies.add_pose(106 * SECOND, WALL + 61 * SECOND + 7 * MS)
    assert list(latencies.milliseconds().values()) == [5.0, 7.0]


def test_the_frames_before_the_first_that_is_known_are_counted_back_from_it() -> None:
    latencies = FrameLatencies()
    latencies.add_due(101 * SECOND, WALL + SECOND)
    latencies.add_pose(100 * SECOND, WALL + 40 * MS)
    assert latencies.milliseconds() == {100 * SECOND: 40.0}


def test_a_camera_stamps_with_the_wall_clock_or_nothing_is_said() -> None:
    camera = FrameLatencies()
    camera.add_pose(WALL, WALL + 33 * MS)
    assert camera.milliseconds() == {WALL: 33.0}
    other = FrameLatencies()
    other.add_pose(100 * SECOND, WALL)
    assert other.milliseconds() == {}
    assert other.summary() == {"latency_ms_p50": None, "latency_ms_p99": None}


def test_the_file_has_a_line_a_pose(tmp_path: Path) -> None:
    latencies = FrameLatencies()
    latencies.add_pose(WALL, WALL + 33 * MS)
    latencies.add_pose(WALL + SECOND, WALL + SECOND + 35 * MS)
    latencies.write(tmp_path / "timing.csv")
    lines = (tmp_path / "timing.csv").read_text().splitlines()
    assert lines == ["stamp,latency_ms", "1800000000.000000000,33.000", "1800000001.000000000,35.000"]
    assert latencies.summary() == {"latency_ms_p50": 34.0, "latency_ms_p99": 34.98}
