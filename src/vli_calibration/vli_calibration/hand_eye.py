"""Where the camera sits on a robot's arm: AX = XB, robust against boards seen upside down and poses that belong to other images.

``T_base_board = T_base_tool · T_tool_cam · T_cam_board`` holds for every image of a board at rest.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares

from vli_common.arrays import BoolArray, FloatArray
from vli_common.errors import InputError
from vli_common.geometry import inverse, pose, so3_exp, so3_log

LEAST_IMAGES = 4
"""Three fix the six unknowns twice over; a fourth tells whether they agree."""
_SAMPLE = 3
_TRIALS = 60
_SEED = 3
_COARSE_RAD = np.radians(4.0)
_COARSE_SHARE = 0.06
"""Coarse limits of agreement: an angle, and a share of the distance to the board. A pose of another image is far beyond."""
_ROUNDS = 4
_LEAST_RAD = 1e-5
_LEAST_M = 1e-6
_MEDIAN_OF_THREE = 1.538
"""Median length of three independent normal errors, in their sigmas."""
_METHODS = (cv2.CALIB_HAND_EYE_PARK, cv2.CALIB_HAND_EYE_DANIILIDIS, cv2.CALIB_HAND_EYE_HORAUD)


@dataclass(frozen=True)
class HandEye:
    """The estimate, and how well the arm and the boards agree.

    Args:
        T_tool_cam: (4, 4).
        T_base_board: (4, 4).
        T_cam_board: (N, 4, 4) as given, boards seen upside down turned.
        errors: (N, 6) rotation (rad) and translation (m) by which the arm's prediction of each board is off, in the board frame.
        sigmas: (6,) their robust standard deviations.
    """

    T_tool_cam: FloatArray
    T_base_board: FloatArray
    T_cam_board: FloatArray
    errors: FloatArray
    sigmas: FloatArray

    def predicted_board(self, T_base_tool: FloatArray) -> FloatArray:
        """Return T_cam_board (4, 4) of the board's plane for another pose of the arm."""
        return inverse(T_base_tool @ self.T_tool_cam) @ self.T_base_board


def solve_hand_eye(
    names: Sequence[str], T_base_tool: FloatArray, T_cam_board: FloatArray, turned: FloatArray | None = None
) -> HandEye:
    """Return the hand–eye transform that all poses agree on.

    Args:
        names: of the images, for messages.
        T_base_tool: (N, 4, 4) of the arm.
        T_cam_board: (N, 4, 4) of the boards.
        turned: (4, 4) T_board_board of a board that looks the same turned by 180°; None for one that does not.

    Raises:
        InputError: too few images, the arm never turned, or poses that belong to other images.
    """
    if len(names) < LEAST_IMAGES:
        raise InputError(
            f"arm poses: the board shows in '{len(names)}' images with a pose, expected {LEAST_IMAGES} or more; "
            "take more, or leave out --poses"
        )
    choices = [T_cam_board] if turned is None else [T_cam_board, T_cam_board @ turned]
    X, W, boards, agree = _consensus(T_base_tool, np.stack(choices))
    if not agree.all():
        raise InputError(_disagreement(names, agree, _errors(X, W, T_base_tool, boards)))
    sigmas = np.concatenate([np.full(3, 1e-3), np.full(3, 1e-4)])
    for _ in range(_ROUNDS):
        X, W = _refined(X, W, T_base_tool, boards, sigmas)
        sigmas = _spread(_errors(X, W, T_base_tool, boards))
    return HandEye(X, W, boards, _errors(X, W, T_base_tool, boards), sigmas)


def _consensus(arm: FloatArray, choices: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Return X, W, the boards (N, 4, 4) as chosen, and which images agree, of the sample that most agree with (RANSAC)."""
    count = len(arm)
    samples = list(itertools.combinations(range(count), _SAMPLE))
    if len(samples) > _TRIALS:
        samples = [samples[i] for i in np.random.default_rng(_SEED).choice(len(samples), _TRIALS, replace=False)]
    best: tuple[tuple[int, float], FloatArray, FloatArray, FloatArray, BoolArray] | None = None
    for sample in samples:
        for flips in itertools.product(range(len(choices)), repeat=_SAMPLE - 1):
            picked = choices[(0, *flips), sample]
            X = _closed_form(arm[list(sample)], picked)
            if X is None:
                continue
            W = _mean_pose(arm[list(sample)] @ X @ picked)
            boards, size = _nearest(X, W, arm, choices)
            agree = size < 1
            score = (int(agree.sum()), -float(np.minimum(size, 1.0).sum()))
            if best is None or score > best[0]:
                best = score, X, W, boards, agree
    if best is None:
        raise InputError("arm poses: the tool hardly turns between the images, so they do not tell where the camera sits on it; "
                         "take views turned about two axes")  # fmt: skip
    return _with_all_that_agree(arm, choices, *best[1:])


def _with_all_that_agree(
    arm: FloatArray, choices: FloatArray, X: FloatArray, W: FloatArray, boards: FloatArray, agree: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Return the solution from every image that agrees, where that loses none."""
    if agree.sum() < _SAMPLE:
        return X, W, boards, agree
    for method in _METHODS:
        other = _closed_form(arm[agree], boards[agree], method)
        if other is None:
            continue
        mean = _mean_pose(arm[agree] @ other @ boards[agree])
        rechosen, size = _nearest(other, mean, arm, choices)
        if (size < 1).sum() >= agree.sum():
            return other, mean, rechosen, size < 1
    return X, W, boards, agree


def _nearest(X: FloatArray, W: FloatArray, arm: FloatArray, choices: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return for each image the choice (N, 4, 4) that agrees best, and by how much it is off in units of the coarse limits."""
    sizes = []
    for boards in choices:
        error = _errors(X, W, arm, boards)
        distance = np.linalg.norm(boards[:, :3, 3], axis=1)
        turn = np.linalg.norm(error[:, :3], axis=1) / _COARSE_RAD
        sizes.append(np.maximum(turn, np.linalg.norm(error[:, 3:], axis=1) / (_COARSE_SHARE * distance)))
    picked = np.argmin(sizes, axis=0)
    index = np.arange(len(arm))
    return choices[picked, index], np.stack(sizes)[picked, index]


def _closed_form(arm: FloatArray, boards: FloatArray, method: int = _METHODS[0]) -> FloatArray | None:
    """Return X (4, 4) of OpenCV's closed forms, None where they find none."""
    try:
        R, t = cv2.calibrateHandEye(
            list(arm[:, :3, :3]), list(arm[:, :3, 3]), list(boards[:, :3, :3]), list(boards[:, :3, 3]), method=method
        )
    except cv2.error:
        return None
    if R is None or not (np.isfinite(R).all() and np.isfinite(t).all()) or abs(np.linalg.det(R) - 1) > 1e-3:
        return None
    return pose(R, t.ravel())


def _mean_pose(poses: FloatArray) -> FloatArray:
    u, _, vt = np.linalg.svd(poses[:, :3, :3].sum(axis=0))
    return pose(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, np.median(poses[:, :3, 3], axis=0))


def _errors(X: FloatArray, W: FloatArray, arm: FloatArray, boards: FloatArray) -> FloatArray:
    """Return (N, 6): rotation vector and translation from each board as seen to the board as the arm predicts it."""
    off = inverse(boards) @ inverse(arm @ X) @ W
    return np.concatenate([so3_log(off[:, :3, :3]), off[:, :3, 3]], axis=1)


def _refined(
    X: FloatArray, W: FloatArray, arm: FloatArray, boards: FloatArray, sigmas: FloatArray
) -> tuple[FloatArray, FloatArray]:
    def moved(step: FloatArray) -> tuple[FloatArray, FloatArray]:
        return X @ pose(so3_exp(step[:3]), step[3:6]), W @ pose(so3_exp(step[6:9]), step[9:])

    def cost(step: FloatArray) -> FloatArray:
        return np.ravel(_errors(*moved(step), arm, boards) / sigmas)

    return moved(least_squares(cost, np.zeros(12), loss="soft_l1", x_scale="jac").x)


def _spread(errors: FloatArray) -> FloatArray:
    """Return (6,) standard deviations, one for the rotations and one for the translations."""
    freedom = np.sqrt(max(len(errors) - 2, 1) / len(errors))
    turn, shift = (
        np.median(np.linalg.norm(part, axis=1)) / _MEDIAN_OF_THREE / freedom for part in (errors[:, :3], errors[:, 3:])
    )
    return np.repeat([max(float(turn), _LEAST_RAD), max(float(shift), _LEAST_M)], 3)


def _disagreement(names: Sequence[str], agree: BoolArray, errors: FloatArray) -> str:
    if 2 * agree.sum() <= len(agree):
        return (
            f"arm poses fit the boards in only '{int(agree.sum())}' of {len(agree)} images; expected the pose of each image's "
            "own moment, T_base_tool: check their order and convention, or leave out --poses"
        )
    wrong = [
        f"'{name}' ({np.degrees(np.linalg.norm(error[:3])):.0f}°, {1e3 * np.linalg.norm(error[3:]):.0f} mm off)"
        for name, error in zip(np.asarray(names)[~agree], errors[~agree], strict=True)
    ]
    return (
        f"arm poses out of order or wrong: {', '.join(wrong[:4])}{' …' if len(wrong) > 4 else ''} do not fit the other images; "
        "expected the pose of each image's own moment: correct the file, or leave those images out"
    )
