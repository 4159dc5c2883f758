"""Rotations and poses against scipy, finite differences and their own definitions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from vli_common import geometry

vectors = arrays(np.float64, 3, elements=st.floats(-3.0, 3.0))
RANDOM = np.random.default_rng(7)


def random_poses(count: int) -> np.ndarray:
    return geometry.pose(Rotation.random(count, random_state=3).as_matrix(), RANDOM.normal(size=(count, 3)))


@given(vectors)
def test_the_exponential_is_scipys(omega: np.ndarray) -> None:
    np.testing.assert_allclose(geometry.so3_exp(omega), Rotation.from_rotvec(omega).as_matrix(), atol=1e-14)


@given(vectors.filter(lambda v: np.linalg.norm(v) < np.pi - 1e-6))
def test_the_logarithm_undoes_the_exponential(omega: np.ndarray) -> None:
    np.testing.assert_allclose(geometry.so3_log(geometry.so3_exp(omega)), omega, atol=1e-8)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1e-8, 1e-6, 1e-3, np.pi - 1e-9, np.pi])
def test_tiny_angles_and_half_turns_keep_their_axis(angle: float) -> None:
    axis = np.array([0.6, -0.48, 0.64])
    log = geometry.so3_log(geometry.so3_exp(angle * axis))
    assert np.linalg.norm(log) == pytest.approx(angle, abs=1e-9)
    if angle > 1e-7:
        assert abs(log @ axis) == pytest.approx(angle, rel=1e-7)


@given(vectors.filter(lambda v: 1e-3 < np.linalg.norm(v) < 3.0))
def test_the_right_jacobian_is_the_derivative_of_the_exponential(omega: np.ndarray) -> None:
    step = 1e-6
    columns = [
        (
            geometry.so3_log(geometry.so3_exp(omega).T @ geometry.so3_exp(omega + step * e))
            - geometry.so3_log(geometry.so3_exp(omega).T @ geometry.so3_exp(omega - step * e))
        )
        / (2 * step)
        for e in np.eye(3)
    ]
    np.testing.assert_allclose(geometry.so3_right_jacobian(omega), np.stack(columns, axis=1), atol=1e-7)


def test_the_right_jacobian_of_no_rotation_is_the_identity() -> None:
    np.testing.assert_allclose(geometry.so3_right_jacobian(np.zeros(3)), np.eye(3))


def test_quaternions_are_scipys_with_positive_w_in_every_branch() -> None:
    half_turns = Rotation.from_rotvec(np.pi * np.vstack([np.eye(3), -np.eye(3)]))
    rotations = Rotation.concatenate([Rotation.random(200, random_state=1), half_turns])
    q = geometry.quaternion_from_rotation(rotations.as_matrix())
    expected = rotations.as_quat()
    expected *= np.sign((q * expected).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(q, expected, atol=1e-14)
    assert (q[:, 3] >= 0).all()
    np.testing.assert_allclose(geometry.rotation_from_quaternion(3.0 * q), rotations.as_matrix(), atol=1e-14)


def test_a_pose_times_its_inverse_is_the_identity_for_stacks_of_any_shape() -> None:
    T = random_poses(12).reshape(3, 4, 4, 4)
    np.testing.assert_allclose(T @ geometry.inverse(T), np.broadcast_to(np.eye(4), T.shape), atol=1e-14)


@given(vectors, vectors)
def test_the_rotation_between_two_directions_turns_one_into_the_other(a: np.ndarray, b: np.ndarray) -> None:
    if min(np.linalg.norm(a), np.linalg.norm(b)) < 1e-3:
        return
    turned = geometry.rotation_between(a, b) @ (a / np.linalg.norm(a))
    np.testing.assert_allclose(turned, b / np.linalg.norm(b), atol=1e-8)


def test_opposite_directions_are_half_a_turn_apart() -> None:
    for axis in np.eye(3):
        np.testing.assert_allclose(geometry.rotation_between(axis, -axis) @ axis, -axis, atol=1e-14)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.2, 5.0))
def test_alignment_finds_rotation_translation_and_scale(seed: int, scale: float) -> None:
    random = np.random.default_rng(seed)
    source = random.normal(size=(20, 3))
    T = geometry.pose(Rotation.random(random_state=seed).as_matrix(), random.normal(size=3))
    found, s = geometry.align(source, scale * source @ T[:3, :3].T + T[:3, 3], with_scale=True)
    np.testing.assert_allclose(found, T, atol=1e-9)
    assert s == pytest.approx(scale)


def test_alignment_of_mirrored_points_is_a_rotation_nevertheless() -> None:
    source = RANDOM.normal(size=(30, 3))
    T, s = geometry.align(source, source * [1, 1, -1])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert s == 1.0


def test_interpolation_ends_at_both_poses_and_is_scipys_slerp_between() -> None:
    from scipy.spatial.transform import Slerp

    T0, T1 = random_poses(2)
    for t in (0.0, 0.3, 1.0):
        T = geometry.interpolate(T0, T1, t)
        np.testing.assert_allclose(
            T[:3, :3], Slerp([0, 1], Rotation.from_matrix([T0[:3, :3], T1[:3, :3]]))(t).as_matrix(), atol=1e-12
        )
        np.testing.assert_allclose(T[:3, 3], (1 - t) * T0[:3, 3] + t * T1[:3, 3], atol=1e-14)
