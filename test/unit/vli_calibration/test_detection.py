"""Finding targets: to a fraction of a pixel in good light, at all in bad light, and never where there is none."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from board_scenes import BOARD, RADTAN4, SIZE, board_pose_at, picture, project, with_glare, with_stripe

from vli_calibration.detection import TargetDetector
from vli_calibration.subpixel import board_grey
from vli_calibration.targets import Target, parse_target
from vli_calibration.types import Detection
from vli_common.arrays import ByteArray, FloatArray

TILTED = board_pose_at(BOARD, 0.075, np.array([0.3, -0.35]), np.array([0.02, -0.03]), 0.2)
GRID = parse_target("aprilgrid:5x4:0.008:0.3")
CHARUCO = parse_target("charuco:8x6:0.007:0.005:4X4_50")


def errors_px(target: Target, T: FloatArray, image: ByteArray) -> tuple[Detection, FloatArray]:
    """Return what was found and how far off each corner is (K,)."""
    found = TargetDetector(target).detect(image)
    assert isinstance(found, Detection), found
    return found, np.linalg.norm(found.pixels - project(RADTAN4, T, target.points)[found.ids], axis=1)


@pytest.mark.parametrize("target", [BOARD, GRID, CHARUCO], ids=lambda target: target.spec)
def test_corners_are_found_to_a_fraction_of_a_pixel(target: Target) -> None:
    T = board_pose_at(target, 0.095, np.array([0.3, -0.2]), np.zeros(2), 0.3)
    found, error = errors_px(target, T, picture(target, RADTAN4, T, np.random.default_rng(0)))
    assert len(found) >= 0.9 * len(target.points)
    assert (np.diff(found.ids) > 0).all()
    assert np.median(error) < 0.08


@pytest.mark.parametrize(
    ("light", "limit_px"),
    [
        ({"black": 60, "white": 72, "noise": 1.5}, 0.35),
        ({"black": 3, "white": 22, "noise": 1.0}, 0.2),
        ({"blur_px": 2.5}, 0.25),
        ({"noise": 15.0}, 0.3),
    ],
    ids=["low contrast", "dark", "blurred", "noisy"],
)
def test_a_chessboard_is_found_in_bad_light(light: dict[str, float], limit_px: float) -> None:
    found, error = errors_px(BOARD, TILTED, picture(BOARD, RADTAN4, TILTED, np.random.default_rng(1), **light))
    assert len(found) >= 50
    assert np.median(error) < limit_px


@pytest.mark.parametrize(
    "disturb",
    [
        lambda grey: with_stripe(grey, 200.0),
        lambda grey: with_stripe(grey, 290.0, channel=0),
        lambda grey: with_glare(grey, (330.0, 230.0), 80.0, 150.0),
    ],
    ids=["red stripe", "blue stripe", "glare"],
)
def test_a_chessboard_is_found_under_a_stripe_or_glare(disturb: Callable[[ByteArray], ByteArray]) -> None:
    image = disturb(picture(BOARD, RADTAN4, TILTED, np.random.default_rng(2)))
    found, error = errors_px(BOARD, TILTED, image)
    assert len(found) >= 48
    assert np.median(error) < 0.25


@pytest.mark.parametrize("spin", [0.0, 1.5, 3.0, -1.6])
def test_a_board_with_unlike_ends_is_numbered_alike_however_it_is_turned(spin: float) -> None:
    T = board_pose_at(BOARD, 0.1, np.array([0.2, 0.1]), np.zeros(2), spin)
    _, error = errors_px(BOARD, T, picture(BOARD, RADTAN4, T, np.random.default_rng(3)))
    assert error.max() < 0.5


def test_a_board_with_like_ends_has_its_first_row_pointing_to_the_right() -> None:
    board = parse_target("chessboard:8x6:0.005")
    for spin in (0.1, 3.0):
        T = board_pose_at(board, 0.1, np.array([0.2, 0.1]), np.zeros(2), spin)
        found = TargetDetector(board).detect(picture(board, RADTAN4, T, np.random.default_rng(4)))
        assert isinstance(found, Detection)
        along = found.pixels[7] - found.pixels[0]
        assert along[0] > 0


def test_tags_are_told_apart_from_a_part_of_the_grid() -> None:
    T = board_pose_at(GRID, 0.07, np.array([0.1, 0.2]), np.array([0.3, 0.1]))
    found, error = errors_px(GRID, T, picture(GRID, RADTAN4, T, np.random.default_rng(5)))
    assert 8 <= len(found) < len(GRID.points)
    assert np.median(error) < 0.1


def test_a_grid_that_is_turned_or_drawn_with_a_single_frame_is_understood() -> None:
    grid = parse_target("aprilgrid:3x3:0.02:0.4")
    side = 80
    sheet = np.full((480, 480), 255, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for index in range(9):
        tag = cv2.aruco.generateImageMarker(dictionary, index, side, borderBits=1)
        u, v = 60 + 112 * (index % 3), 60 + 112 * (2 - index // 3)
        sheet[v : v + side, u : u + side] = tag
    found = TargetDetector(grid).detect(sheet)
    assert isinstance(found, Detection)
    assert len(found) == 36
    printed = (grid.points[found.ids, :2] - grid.points[:, :2].min(axis=0)) / 0.02 * side + [59.5, 59.5]
    assert np.abs(found.pixels - printed).max() < 1.5


@pytest.mark.parametrize("target", [BOARD, GRID, CHARUCO], ids=lambda target: target.spec)
def test_an_image_with_only_a_stripe_has_no_board_and_says_why(target: Target) -> None:
    rng = np.random.default_rng(6)
    dark = np.clip(rng.normal(4, 1.5, SIZE[::-1]), 0, 255).astype(np.uint8)
    why = TargetDetector(target).detect(with_stripe(dark, 210.0))
    assert isinstance(why, str)
    assert "dark" in why or "to be seen" in why


@pytest.mark.parametrize(
    ("image", "why"),
    [
        (np.full((480, 640), 10, np.uint8), "too dark"),
        (np.full((480, 640), 128, np.uint8), "no contrast"),
        (np.random.default_rng(7).integers(0, 255, (480, 640)).astype(np.uint8), "no chessboard pattern"),
    ],
)
def test_the_reason_says_what_is_wrong_with_the_image(image: ByteArray, why: str) -> None:
    reason = TargetDetector(BOARD).detect(image)
    assert isinstance(reason, str)
    assert why in reason


def test_another_board_is_named_by_its_size() -> None:
    image = picture(BOARD, RADTAN4, TILTED, np.random.default_rng(8))
    reason = TargetDetector(parse_target("chessboard:8x5:0.005")).detect(image)
    assert isinstance(reason, str)
    assert reason.startswith("9x6 inner corners to be seen instead of 8x5")


def test_the_grey_for_the_corners_leaves_the_lasers_channel_out() -> None:
    rng = np.random.default_rng(9)
    grey = picture(BOARD, RADTAN4, TILTED, rng)
    for channel in range(3):
        striped = with_stripe(grey, 200.0, channel)
        others = np.delete(striped, channel, axis=2).mean(axis=2)
        assert np.abs(board_grey(striped) - others).max() <= 0.5
    assert board_grey(grey) is grey


def test_all_images_are_answered_in_order() -> None:
    board = picture(BOARD, RADTAN4, TILTED, np.random.default_rng(10))
    nothing = np.full_like(board, 128)
    results = TargetDetector(BOARD).detect_all([nothing, board, nothing, board])
    assert [isinstance(result, str) for result in results] == [True, False, True, False]
