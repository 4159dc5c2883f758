"""The covariance of a frame from that of its keyframe, against sampled poses."""

from __future__ import annotations

import numpy as np
from scene import Scan, calibration

from vli_backend.backend import BackEnd
from vli_backend.config import BackEndConfig
from vli_backend.pose_covariance import PoseCovariance, adjoint, in_map_axes
from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, pose, so3_exp, so3_log
from vli_common.types import LaserScan, Mode


def _perturbed(T: FloatArray, xi: FloatArray) -> FloatArray:
    return T @ pose(so3_exp(xi[:3]), xi[3:])


def _covariance(rng: np.random.Generator, scale: float) -> FloatArray:
    root = scale * rng.normal(size=(6, 6))
    return root @ root.T


def test_the_adjoint_moves_a_perturbation_to_the_other_side() -> None:
    T = pose(so3_exp(np.array([0.3, -0.2, 0.5])), np.array([0.01, 0.02, -0.03]))
    xi = 1e-7 * np.array([1.0, 2.0, -1.0, 0.5, -0.3, 0.2])
    left = _perturbed(np.eye(4), adjoint(T) @ xi) @ T
    np.testing.assert_allclose(left, _perturbed(T, xi), atol=1e-12)


def test_the_covariance_of_a_frame_is_that_of_poses_drawn_around_keyframe_and_frame() -> None:
    rng = np.random.default_rng(3)
    T_imu_cam = pose(so3_exp(np.array([0.1, 2.9, 0.2])), np.array([0.005, -0.004, 0.008]))
    keyframe = pose(so3_exp(np.array([0.2, 0.1, -0.7])), np.array([0.1, 0.2, 0.3]))
    step = pose(so3_exp(np.array([0.05, -0.03, 0.02])), np.array([0.003, 0.001, -0.002]))
    frame = keyframe @ step
    P_keyframe, P_camera = _covariance(rng, 1e-4), _covariance(rng, 1e-4)
    carried = PoseCovariance(T_imu_cam, 1.0)
    carried.set_keyframe(0, keyframe, P_keyframe)

    samples = []
    for xi, own in zip(
        rng.multivariate_normal(np.zeros(6), P_keyframe, 20000),
        rng.multivariate_normal(np.zeros(6), P_camera, 20000),
        strict=True,
    ):
        drawn = _perturbed(_perturbed(keyframe, xi) @ step @ T_imu_cam, own) @ inverse(T_imu_cam)
        turn = drawn[:3, :3] @ frame[:3, :3].T
        samples.append(np.concatenate([drawn[:3, 3] - frame[:3, 3], so3_log(turn)]))
    expected = np.cov(np.array(samples).T)
    found = carried.of_frame(frame, np.linalg.inv(P_camera))
    np.testing.assert_allclose(found, expected, atol=0.04 * np.abs(expected).max())


def test_a_keyframe_is_reported_in_the_order_of_ros_and_scaled() -> None:
    carried = PoseCovariance(np.eye(4), 0.5)
    turned = so3_exp(np.array([0.0, 0.0, np.pi / 2]))
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    carried.set_keyframe(0, pose(turned, np.zeros(3)), covariance)
    np.testing.assert_allclose(np.diag(carried.of_keyframe()), 0.5 * np.array([5.0, 4.0, 6.0, 2.0, 1.0, 3.0]))
    np.testing.assert_allclose(np.trace(in_map_axes(covariance, turned)), np.trace(covariance))


def test_on_the_map_the_place_it_was_seen_from_counts_too_and_goes_on_counting_beyond_it() -> None:
    def at(x: float) -> FloatArray:
        return pose(np.eye(3), np.array([x, 0.0, 0.0]))

    def sigma() -> float:
        return float(np.sqrt(carried.of_keyframe()[0, 0]))

    carried = PoseCovariance(np.eye(4), 1.0)
    for second in range(11):
        carried.set_keyframe(second * 10**9, at(0.01 * second), (1e-5 * second) ** 2 * np.eye(6))
    against_the_map = 1e-12 * np.eye(6)
    carried.set_keyframe(12 * 10**9, at(0.05), against_the_map, on_map=True)
    np.testing.assert_allclose(sigma(), 5e-5, rtol=0.01)
    carried.set_keyframe(13 * 10**9, at(0.02), against_the_map, on_map=True)
    np.testing.assert_allclose(sigma(), 2e-5, rtol=0.01)
    carried.set_keyframe(14 * 10**9, at(-0.01), (1e-5) ** 2 * np.eye(6))
    np.testing.assert_allclose(sigma(), np.hypot(2e-5, 1e-5), rtol=0.01)


def test_the_youngest_places_are_not_in_the_map_yet() -> None:
    carried = PoseCovariance(np.eye(4), 1.0)
    carried.set_keyframe(0, np.eye(4), 1e-8 * np.eye(6))
    carried.set_keyframe(2 * 10**9, np.eye(4), 4e-8 * np.eye(6), on_map=True)
    np.testing.assert_allclose(np.diag(carried.of_keyframe()), 4e-8)


def test_what_is_reported_starts_at_zero_and_grows_along_an_odometry() -> None:
    back_end, scan, sigmas = BackEnd(calibration(), BackEndConfig(), Mode.VLI_ODOM), Scan(), []
    for item in scan.frames(7.0):
        if isinstance(item, LaserScan):
            back_end.add_scan(item)
            continue
        output = back_end.add_frame(item)
        scan.bias = output.bias or scan.bias
        if output.pose is not None:
            sigmas.append(np.sqrt(np.trace(output.pose.covariance[:3, :3])))
    assert sigmas[0] < 1e-5
    thirds = [float(np.mean(part)) for part in np.array_split(np.array(sigmas), 3)]
    assert thirds[0] < thirds[1] < thirds[2] < 1e-3
