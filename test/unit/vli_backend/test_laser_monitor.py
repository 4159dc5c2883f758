"""A laser plane that has moved: along the stripe, with range, as a scale; and none of it where it has not."""

from __future__ import annotations

import numpy as np
import pytest
from scene import calibration

from vli_backend.condense import refine
from vli_backend.landmarks import LandmarkTable
from vli_backend.laser_monitor import LaserPlaneMonitor
from vli_backend.plane_residuals import PlaneResiduals, plane_residuals
from vli_common.arrays import FloatArray


def _monitor() -> LaserPlaneMonitor:
    laser = calibration().laser
    assert laser is not None
    return LaserPlaneMonitor(laser)


def _residuals(along: float = 0.0, with_range: float = 0.0, outliers: float = 0.0, count: int = 400) -> PlaneResiduals:
    """Return residuals with a relative error per unit of x/z, and one per doubling of the range."""
    rng = np.random.default_rng(0)
    rays, depth = rng.uniform(-0.6, 0.6, (count, 2)), rng.uniform(0.025, 0.045, count)
    relative = along * rays[:, 0] + with_range * (depth / 0.035 - 1.0) + 0.003 * rng.normal(size=count)
    wrong = rng.uniform(size=count) < outliers
    relative[wrong] += rng.uniform(-0.2, 0.3, count)[wrong]
    sigma = np.full(count, 0.002) / depth
    return PlaneResiduals(rays, 1.0 / (depth * (1.0 + relative)), sigma, 1.0 / depth, sigma)


def _edges(count: int) -> PlaneResiduals:
    """Return features at depth edges: the patch shows the nearer side, the laser measures either; vision is not sure of them."""
    rng = np.random.default_rng(2)
    depth = rng.uniform(0.025, 0.03, count)
    laser = 1.0 / (depth * (1.0 + 0.02 * rng.uniform(size=count)))
    return PlaneResiduals(rng.uniform(-0.6, 0.6, (count, 2)), laser, 0.002 * laser, 1.0 / depth, 0.004 / depth)


def test_a_good_calibration_is_left_in_peace() -> None:
    monitor = _monitor()
    monitor.add_residuals(_residuals(outliers=0.1))
    for scale in (1.01, 0.985, 1.0, 0.99):
        monitor.add_scale(scale, 0.015)
    assert monitor.hint == ""


def test_features_at_depth_edges_are_no_evidence() -> None:
    monitor = _monitor()
    monitor.add_residuals(_residuals())
    monitor.add_residuals(_edges(250))
    assert monitor.hint == ""


def test_noise_of_the_laser_is_no_error_that_grows_with_range() -> None:
    rng, count = np.random.default_rng(4), 1500
    rays, depth = rng.uniform(-0.6, 0.6, (count, 2)), rng.uniform(0.03, 0.032, count)
    laser, vision = (1.0 / depth + sigma * rng.normal(size=count) for sigma in (0.7, 0.1))
    monitor = _monitor()
    monitor.add_residuals(PlaneResiduals(rays, laser, np.full(count, 0.7), vision, np.full(count, 0.1)))
    assert monitor.hint == ""


def test_a_tilt_along_the_stripe_is_told() -> None:
    monitor = _monitor()
    monitor.add_residuals(_residuals(along=0.008, outliers=0.1))
    assert "laser plane may have moved" in monitor.hint
    assert "along the stripe" in monitor.hint
    assert "vli calibrate check" in monitor.hint


def test_an_error_that_grows_with_range_is_told() -> None:
    monitor = _monitor()
    monitor.add_residuals(_residuals(with_range=0.025, outliers=0.1))
    assert "depths are +2." in monitor.hint
    assert "at twice the range" in monitor.hint


def test_a_scale_that_the_imu_contradicts_again_and_again_is_told() -> None:
    monitor = _monitor()
    monitor.add_scale(1.05, 0.03)
    assert monitor.hint == ""
    for _ in range(12):
        monitor.add_scale(1.05, 0.03)
    assert "the IMU says" in monitor.hint


def test_a_scale_that_no_plane_has_tells_of_a_motion_that_is_too_even_for_the_imu() -> None:
    monitor = _monitor()
    for scale in (1.8, 4.2, 3.5, 3.1, 0.4):
        monitor.add_scale(scale, 0.08)
    assert monitor.hint == ""


def test_a_handful_of_landmarks_is_no_evidence() -> None:
    monitor = _monitor()
    monitor.add_residuals(_residuals(along=0.05, count=50))
    assert monitor.hint == ""


def _table(depth_factor: float) -> tuple[LandmarkTable, FloatArray]:
    """Return landmarks seen from five poses, with a laser depth in one that is off by a factor."""
    rng = np.random.default_rng(1)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = 0.004 * np.arange(5)
    points = np.column_stack([rng.uniform(-0.01, 0.02, (30, 2)), rng.uniform(0.03, 0.04, 30)])
    table, ids = LandmarkTable(6), np.arange(1, 31)
    for T in poses:
        seen = points - T[:3, 3]
        table.add_keyframe(ids, seen[:, :2] / seen[:, 2:], np.tile(1e4 * np.eye(2), (30, 1, 1)), np.zeros(30, np.bool_), 30.0)
    inverse_depth = 1.0 / (depth_factor * points[:, 2])
    table.set_depths(2, np.arange(30), inverse_depth, np.full(30, 0.01), np.ones(30), True)
    refine(table.arrays, poses, table.usable, 1.0, (2.0, 150.0), 20)
    return table, poses


@pytest.mark.parametrize("factor", [1.0, 1.03])
def test_laser_depths_are_compared_with_what_vision_alone_says(factor: float) -> None:
    table, poses = _table(factor)
    before = table.arrays.rho.copy()
    found = plane_residuals(table, table.usable, poses, 1.0, (2.0, 150.0))
    assert len(found) == 30
    np.testing.assert_allclose(found.error, factor - 1.0, atol=2e-3)
    np.testing.assert_array_equal(table.arrays.rho, before)


def test_landmarks_without_laser_depth_or_long_tracks_are_left_out() -> None:
    table, poses = _table(1.0)
    assert len(plane_residuals(table, np.zeros(30, np.bool_), poses, 1.0, (2.0, 150.0))) == 0
    table.arrays.depth_sigma[:] = 0.0
    assert len(plane_residuals(table, table.usable, poses, 1.0, (2.0, 150.0))) == 0
