"""Hand–eye: exact without noise, robust against boards seen upside down, and clear about poses that belong elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from vli_calibration.hand_eye import solve_hand_eye
from vli_common.arrays import FloatArray
from vli_common.errors import InputError
from vli_common.geometry import inverse, pose, so3_exp

X = pose(so3_exp(np.array([0.3, -1.2, 0.8])), np.array([0.1, -0.016, 0.002]))
W = pose(so3_exp(np.array([0.1, 3.0, 0.2])), np.array([0.1, 0.41, 0.09]))
TURNED = np.array([[-1.0, 0, 0, 0.04], [0, -1.0, 0, 0.025], [0, 0, 1, 0], [0, 0, 0, 1]])


def poses(count: int = 14, seed: int = 0, noise: float = 1.0) -> tuple[list[str], FloatArray, FloatArray]:
    """Return names, T_base_tool and T_cam_board with 0.5 mrad and 0.05 mm of noise."""
    rng = np.random.default_rng(seed)
    boards = np.stack([
        pose(so3_exp(rng.uniform(-0.6, 0.6, 3)), rng.uniform([-0.02, -0.02, 0.05], [0.02, 0.02, 0.11])) for _ in range(count)
    ])  # fmt: skip
    arm = W @ inverse(boards) @ inverse(X)
    off = np.stack([pose(so3_exp(noise * 5e-4 * rng.normal(size=3)), noise * 5e-5 * rng.normal(size=3)) for _ in range(count)])
    return [f"im{k}.png" for k in range(count)], arm, boards @ off


def test_without_noise_the_transform_comes_back() -> None:
    found = solve_hand_eye(*poses(noise=0.0))
    np.testing.assert_allclose(found.T_tool_cam, X, atol=1e-6)
    np.testing.assert_allclose(found.T_base_board, W, atol=1e-6)


def test_noise_is_measured_and_averaged() -> None:
    names, arm, boards = poses(30)
    found = solve_hand_eye(names, arm, boards)
    assert found.sigmas[0] == pytest.approx(5e-4, rel=0.4)
    assert found.sigmas[3] == pytest.approx(5e-5, rel=0.4)
    assert np.linalg.norm(found.T_tool_cam[:3, 3] - X[:3, 3]) < 2e-4
    np.testing.assert_allclose(found.predicted_board(arm[4]), boards[4], atol=3e-3)


def test_boards_seen_upside_down_are_turned() -> None:
    names, arm, boards = poses()
    flipped = boards.copy()
    flipped[[2, 5, 9]] = boards[[2, 5, 9]] @ TURNED
    found = solve_hand_eye(names, arm, flipped, TURNED)
    plain = solve_hand_eye(names, arm, boards)
    # Which of the two ends is the first corner is free for the whole set.
    same = np.abs(found.T_base_board - plain.T_base_board).max() < 1e-6
    turned = np.abs(found.T_base_board - plain.T_base_board @ TURNED).max() < 1e-6
    assert same or turned
    np.testing.assert_allclose(found.T_tool_cam, plain.T_tool_cam, atol=1e-6)


def test_two_poses_that_changed_places_are_named() -> None:
    names, arm, boards = poses()
    arm[[3, 8]] = arm[[8, 3]]
    with pytest.raises(InputError, match=r"out of order or wrong: 'im3.png' .*'im8.png'") as caught:
        solve_hand_eye(names, arm, boards)
    assert "\n" not in str(caught.value)


def test_poses_that_belong_to_other_images_throughout_are_told() -> None:
    names, arm, boards = poses()
    with pytest.raises(InputError, match=r"fit the boards in only '\d+' of 14 images"):
        solve_hand_eye(names, np.roll(arm, 1, axis=0), boards)


def test_too_few_images_are_told() -> None:
    names, arm, boards = poses(3)
    with pytest.raises(InputError, match="shows in '3' images with a pose, expected 4 or more"):
        solve_hand_eye(names, arm, boards)


def test_an_arm_that_never_turns_is_told() -> None:
    names, _, boards = poses(5)
    boards[:, :3, :3] = np.eye(3)
    arm = W @ inverse(boards) @ inverse(X)
    with pytest.raises(InputError, match="arm poses"):
        solve_hand_eye(names, arm, np.stack([pose(so3_exp(np.full(3, 0.3 * k)), T[:3, 3]) for k, T in enumerate(boards)]))
