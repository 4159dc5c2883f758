"""Frames between keyframes."""

from __future__ import annotations

import numpy as np

from vli_backend.window import FrameRecord, close_interval
from vli_common.geometry import pose
from vli_common.types import FrameKind, LaserScan

MS = 1_000_000
PERIOD = 33 * MS


def _record(stamp_ns: int, stationary: bool = False) -> FrameRecord:
    return FrameRecord(stamp_ns, pose(np.eye(3), np.array([stamp_ns * 1e-12, 0.0, 0.0])), stationary)


def _scan(stamp_ns: int) -> LaserScan:
    return LaserScan(stamp_ns, np.ones((4, 3)), np.ones((4, 2)), np.ones(4), np.ones(4))


def test_stripes_get_the_pose_that_the_long_frames_around_them_tell() -> None:
    interval = close_interval([_record(k * PERIOD) for k in range(4)], [_scan(k * PERIOD + PERIOD // 2) for k in range(3)])
    short, long = FrameKind.SHORT.value, FrameKind.LONG.value
    np.testing.assert_array_equal(interval.kinds, [short, long, short, long, short])
    poses = interval.poses(_record(0).T_map_camera, _record(3 * PERIOD).T_map_camera)
    np.testing.assert_allclose(poses[:, 0, 3], interval.stamps * 1e-12, atol=1e-12)


def test_stripes_within_a_gap_between_long_frames_get_none() -> None:
    frames = [_record(stamp) for stamp in (0, PERIOD, PERIOD + 300 * MS, 2 * PERIOD + 300 * MS)]
    taken = [PERIOD // 2, PERIOD + PERIOD // 2, PERIOD + 290 * MS, PERIOD + 300 * MS + PERIOD // 2]
    interval = close_interval(frames, [_scan(stamp) for stamp in taken], 250 * MS)
    assert list(interval.scans) == [taken[0], taken[3]]
    assert len(interval.stamps) == 4


def test_at_rest_a_gap_between_long_frames_does_no_harm() -> None:
    interval = close_interval([_record(0, True), _record(400 * MS, True)], [_scan(200 * MS)], 250 * MS)
    assert list(interval.scans) == [200 * MS]
    assert interval.redundant.all()
