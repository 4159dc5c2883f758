"""The joint solve: exact derivatives, the truth within its noise, and what does not belong left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from laser_sets import CAMERA, PLANE, Noise, disturbed_camera, views

from vli_calibration import laser_model as model
from vli_calibration.laser_joint import JointProblem, solve_reduced
from vli_calibration.laser_model import LaserPlane
from vli_common.camera import CameraModel, EquidistantCamera

FISHEYE = EquidistantCamera(300.0, 301.0, 320.0, 240.0, (0.02, -0.01, 0.002, 0.0), 640, 480)
FREE = np.full(8, np.inf)


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["radtan", "equidistant"])
def test_the_derivatives_are_those_of_the_residuals(camera: CameraModel) -> None:
    view = views(1, 3)[0]
    poses = np.broadcast_to(view.T_cam_board, (len(view.stripe), 4, 4))

    def distance(camera: CameraModel, step: np.ndarray, plane: LaserPlane) -> np.ndarray:
        return plane.distance(model.stripe_points(camera, model.moved_pose(view.T_cam_board, step), view.stripe))

    points = model.stripe_points(camera, poses, view.stripe)
    by_camera, by_plane, by_pose = model.stripe_jacobians(camera, poses, points, PLANE)
    values, still = model.camera_parameters(camera), np.zeros(6)
    for index in range(8):
        h = 1e-5 * max(1.0, abs(values[index]))
        ends = [distance(model.with_parameters(camera, values + s * h * np.eye(8)[index]), still, PLANE) for s in (-1, 1)]
        np.testing.assert_allclose(
            by_camera[:, index], (ends[1] - ends[0]) / (2 * h), atol=1e-5 * np.abs(by_camera[:, index]).max()
        )
    for index in range(6):
        ends = [distance(camera, s * 1e-6 * np.eye(6)[index], PLANE) for s in (-1, 1)]
        np.testing.assert_allclose(by_pose[:, index], (ends[1] - ends[0]) / 2e-6, atol=1e-7)
    for index in range(3):
        ends = [distance(camera, still, PLANE.moved(s * 1e-6 * np.eye(3)[index])) for s in (-1, 1)]
        np.testing.assert_allclose(by_plane[:, index], (ends[1] - ends[0]) / 2e-6, atol=1e-8)


def test_without_noise_the_truth_comes_back() -> None:
    problem = JointProblem(views(12, 0, Noise(1e-6, 1e-6)), True, FREE)
    solution = problem.solve(disturbed_camera(), PLANE.moved(np.array([0.01, -0.01, 2e-4])))
    assert solution.converged
    np.testing.assert_allclose(solution.plane.vector, PLANE.vector, atol=1e-6)
    np.testing.assert_allclose(model.camera_parameters(solution.camera), model.camera_parameters(CAMERA), rtol=1e-3, atol=1e-5)


def test_noise_is_measured_and_the_plane_is_as_good_as_it_allows() -> None:
    set_of_views = views(20, 1)
    solution = JointProblem(set_of_views, True, FREE).solve(disturbed_camera(), PLANE)
    assert solution.corner_sigma_px == pytest.approx(0.15, rel=0.1)
    assert solution.stripe_scale == pytest.approx(1.0, rel=0.1)
    assert np.degrees(np.arccos(solution.plane.normal @ PLANE.normal)) < 0.1
    assert abs(solution.plane.d - PLANE.d) < 5e-5


def test_single_corners_and_points_that_do_not_belong_are_left_out() -> None:
    spoiled = views(12, 2)
    pixels, stripe = spoiled[3].pixels.copy(), spoiled[5].stripe.copy()
    pixels[7] += 5.0
    stripe[20:30, 1] += 6.0
    spoiled[3], spoiled[5] = replace(spoiled[3], pixels=pixels), replace(spoiled[5], stripe=stripe)
    solution = JointProblem(spoiled, True, FREE).solve(disturbed_camera(), PLANE)
    assert not solution.corner_kept[3 * 54 + 7]
    assert not solution.stripe_kept[5 * 150 + 20 : 5 * 150 + 30].any()
    assert solution.stripe_kept.mean() > 0.98
    assert abs(solution.plane.d - PLANE.d) < 1e-4


def test_a_camera_that_is_held_stays_and_one_that_is_known_moves_little() -> None:
    given = disturbed_camera()
    held = JointProblem(views(12, 4), True, np.zeros(8)).solve(given, PLANE)
    assert held.camera == given
    tight = JointProblem(views(12, 4), True, np.full(8, 1e-6)).solve(given, PLANE)
    np.testing.assert_allclose(model.camera_parameters(tight.camera), model.camera_parameters(given), atol=1e-5)


def test_a_stripe_without_a_board_counts_by_what_the_arm_knows() -> None:
    set_of_views = views(12, 5)
    empty = np.empty((0, 3))
    arm = np.array([2e-3] * 3 + [1e-4] * 3)
    alone = [replace(view, points=empty, pixels=empty[:, :2], prior=arm) for view in set_of_views[8:]]
    without = JointProblem(set_of_views[:8], True, np.zeros(8)).solve(CAMERA, PLANE)
    joint = JointProblem([*set_of_views[:8], *alone], True, np.zeros(8)).solve(CAMERA, PLANE)
    information = [np.sum([system.hessian for system in found.systems], axis=0) for found in (without, joint)]
    assert (np.diag(information[1]) > np.diag(information[0])).all()
    assert abs(joint.plane.d - PLANE.d) < 1e-4


def test_a_system_that_determines_nothing_is_told() -> None:
    from vli_common.errors import InputError

    with pytest.raises(InputError, match="do not determine"):
        solve_reduced(np.zeros((3, 3)), np.ones(3))
