"""Eq. (4) and the poses of stripes between keyframes."""

from __future__ import annotations

import numpy as np
import pytest

from vli_backend.map_residuals import condense_map, stripe_jacobian
from vli_backend.path_interpolation import interpolate_path
from vli_backend.window import FrameRecord, Interval, Window, close_interval
from vli_common.arrays import FloatArray
from vli_common.geometry import interpolate, inverse, pose, so3_exp, so3_log, transform
from vli_common.types import FrameKind, LaserScan, MapConstraints

T0 = pose(so3_exp(np.array([0.1, -0.2, 0.3])), np.array([0.01, 0.02, -0.005]))
T1 = T0 @ pose(so3_exp(np.array([0.03, 0.05, -0.04])), np.array([0.004, -0.001, 0.002]))


def _records(count: int = 6) -> list[FrameRecord]:
    wiggle = np.random.default_rng(0).normal(scale=1e-3, size=(count, 6))
    wiggle[[0, -1]] = 0.0
    poses = interpolate(T0, T1, np.linspace(0, 1, count)) @ pose(so3_exp(wiggle[:, :3]), wiggle[:, 3:] * 0.1)
    return [FrameRecord(100 * k, T, False) for k, T in enumerate(poses)]


def _scan(stamp: int, points: FloatArray | None = None) -> LaserScan:
    points = np.zeros((3, 3)) if points is None else points
    return LaserScan(stamp, points, points[:, :2], points[:, 0], np.full(len(points), 5e-5))


def test_the_stripe_jacobian_is_that_of_the_interpolated_pose() -> None:
    delta = pose(so3_exp(np.array([0.01, -0.02, 0.005])), np.array([1e-4, 2e-4, -1e-4]))
    base = interpolate(T0, T1, 0.3) @ delta
    numeric = np.empty((6, 12))
    for k in range(12):
        step = np.zeros((2, 6))
        step.flat[k] = 1e-6
        moved = np.stack([T0, T1]) @ pose(so3_exp(step[:, :3]), step[:, 3:])
        change = inverse(base) @ interpolate(moved[0], moved[1], 0.3) @ delta
        numeric[:, k] = np.concatenate([so3_log(change[:3, :3]), change[:3, 3]]) / 1e-6
    np.testing.assert_allclose(stripe_jacobian(T0, T1, 0.3, delta), numeric, atol=1e-5)


def test_an_interval_gives_back_the_frames_it_was_made_of() -> None:
    records = _records()
    interval = close_interval(records, [_scan(250), _scan(50), _scan(900)])
    assert list(interval.stamps) == [50, 100, 200, 250, 300, 400]
    poses = interval.poses(T0, T1)
    np.testing.assert_allclose(poses[2], records[2].T_map_camera, atol=1e-12)
    path = np.array([record.stamp_ns for record in records]), np.stack([record.T_map_camera for record in records])
    np.testing.assert_allclose(poses[3], interpolate_path(*path, np.array([250]))[0], atol=1e-12)
    assert interval.kinds[3] == FrameKind.SHORT.value


def test_frames_follow_when_their_keyframes_move() -> None:
    interval = close_interval(_records(), [])
    shift = pose(np.eye(3), np.array([0.0, 0.0, 0.01]))
    np.testing.assert_allclose(interval.poses(shift @ T0, shift @ T1), shift @ interval.poses(T0, T1), atol=1e-12)


def test_the_window_marks_what_leaves_as_final() -> None:
    window = Window()
    window.append(0, False, None)
    window.append(500, False, close_interval(_records(), [_scan(50)]))
    message = window.poses(np.stack([T0, T1]), 1, session=3)
    assert message.session == 3
    assert list(message.final) == [True] * 6 + [False]
    assert list(message.stamps) == sorted(message.stamps)


def _constraints(interval: Interval, offset: float, sigma: float = 5e-5) -> MapConstraints:
    """Points of the scans that lie ``offset`` above a plane z = 0 of the map, as seen from the true poses."""
    rng = np.random.default_rng(4)
    short = np.flatnonzero(interval.kinds == FrameKind.SHORT.value)
    points, targets, stamps = [], [], []
    for index in short:
        world = np.concatenate([rng.uniform(-0.02, 0.02, (20, 2)), np.zeros((20, 1))], axis=1)
        points.append(transform(inverse(interval.poses(T0, T1)[index]), world + np.array([0.0, 0.0, offset])))
        targets.append(world)
        stamps += [int(interval.stamps[index])] * 20
    count = len(stamps)
    normals = np.tile([0.0, 0.0, 1.0], (count, 1))
    return MapConstraints(
        500, np.array(stamps), np.concatenate(points), np.concatenate(targets), normals, np.full(count, sigma), np.ones(count)
    )


def test_the_map_pulls_both_keyframes_back_onto_it() -> None:
    interval = close_interval(_records(), [_scan(50), _scan(250), _scan(450)])
    constraints = _constraints(interval, offset=2e-5)
    poses = np.stack([T0, T1])
    for _ in range(3):
        quadratic = condense_map(constraints, [0, 500], [interval], range(1), poses, 1.0, 1e3)
        step = -np.linalg.lstsq(quadratic.hessian + 1e-3 * np.eye(12), quadratic.gradient, rcond=None)[0].reshape(-1, 6)
        poses = poses @ pose(so3_exp(step[:, :3]), step[:, 3:])
    final = condense_map(constraints, [0, 500], [interval], range(1), poses, 1.0, 1e3)
    assert (
        final.constant < 1e-3 * condense_map(constraints, [0, 500], [interval], range(1), np.stack([T0, T1]), 1.0, 1e3).constant
    )


def test_a_plane_leaves_sliding_along_it_free() -> None:
    interval = close_interval(_records(), [_scan(50), _scan(250), _scan(450)])
    quadratic = condense_map(_constraints(interval, 0.0), [0, 500], [interval], range(1), np.stack([T0, T1]), 1.0, 1e3)
    slide = np.concatenate([np.zeros(3), T0[:3, :3].T @ [1.0, 0, 0], np.zeros(3), T1[:3, :3].T @ [1.0, 0, 0]])
    lift = np.concatenate([np.zeros(3), T0[:3, :3].T @ [0, 0, 1.0], np.zeros(3), T1[:3, :3].T @ [0, 0, 1.0]])
    assert slide @ quadratic.hessian @ slide < 1e-9 * (lift @ quadratic.hessian @ lift)


def test_a_larger_sigma_scale_weakens_the_map() -> None:
    interval = close_interval(_records(), [_scan(50)])
    args = (_constraints(interval, 1e-5), [0, 500], [interval], range(1), np.stack([T0, T1]))
    strong, weak = condense_map(*args, 1.0, 1e3), condense_map(*args, 2.0, 1e3)
    assert strong.hessian.max() == pytest.approx(4 * weak.hessian.max())


def test_stripes_that_left_the_window_are_ignored() -> None:
    interval = close_interval(_records(), [_scan(50)])
    constraints = _constraints(interval, 1e-4)
    empty = close_interval(_records(), [])
    assert condense_map(constraints, [0, 500], [empty], range(1), np.stack([T0, T1]), 1.0, 1e3).constant == 0.0
