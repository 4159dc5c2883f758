"""The stripe on a board: found on drawn and real images, whatever its direction and colour, and never where there is none."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from laser_sets import BOARD, CAMERA, PLANE, board_poses, drawn, stripe_pixels

from vli_calibration.board_surface import BoardSurface
from vli_calibration.laser_model import LaserPlane, stripe_points
from vli_calibration.stripe_line import fit_stripe_line
from vli_calibration.stripe_on_board import CHANNELS, BoardStripe, Scene, StripeFinder, correlation_length
from vli_common.arrays import FloatArray
from vli_common.geometry import pose, so3_exp

POSE = pose(so3_exp(np.array([0.2, -0.15, 0.1])), np.array([-0.02, -0.022, 0.055]))
SURFACE = BoardSurface(CAMERA, POSE, BOARD)
UPRIGHT = LaserPlane.from_vector(np.array([-0.9, 0.02, -0.43, 0.0145]))
UPRIGHT_POSE = pose(so3_exp(np.array([0.2, -0.15, 0.1])), np.array([-0.03, -0.015, 0.055]))


def errors_px(stripe: BoardStripe, plane: LaserPlane, T_cam_board: FloatArray, axis: int) -> FloatArray:
    """Return by how far kept points are off along an image axis, from the slope of the distance there."""
    pixels = stripe.pixels[stripe.kept]
    step = 0.5 * np.eye(2)[axis]
    ahead, behind, here = (plane.distance(stripe_points(CAMERA, T_cam_board, pixels + shift)) for shift in (step, -step, 0.0))
    return here / (ahead - behind)


@pytest.mark.parametrize("laser", [2, 0], ids=["red", "blue"])
def test_a_stripe_over_black_and_white_squares_is_found_to_a_fifth_of_a_pixel(laser: int) -> None:
    scene = Scene(drawn(POSE, laser=laser), SURFACE)
    finder = StripeFinder.from_images(CAMERA, [scene])
    assert (finder.along_columns, finder.channel) == (True, CHANNELS[laser])
    stripe = finder.find(scene)
    assert stripe is not None
    assert stripe.on_print
    error = errors_px(stripe, PLANE, POSE, 1)
    assert len(error) > 150
    assert abs(np.median(error)) < 0.05
    assert np.sqrt(np.mean(error**2)) < 0.2


def test_a_stripe_along_the_rows_is_told_without_a_calibration_of_the_laser() -> None:
    scene = Scene(drawn(UPRIGHT_POSE, plane=UPRIGHT, vertical=True), BoardSurface(CAMERA, UPRIGHT_POSE, BOARD))
    finder = StripeFinder.from_images(CAMERA, [scene])
    assert not finder.along_columns
    stripe = finder.find(scene)
    assert stripe is not None
    assert np.sqrt(np.mean(errors_px(stripe, UPRIGHT, UPRIGHT_POSE, 0) ** 2)) < 0.2


def test_a_monochrome_image_will_do() -> None:
    grey = np.asarray(drawn(POSE)[:, :, 2])
    scene = Scene(grey, SURFACE)
    finder = StripeFinder.from_images(CAMERA, [scene])
    assert finder.channel == "grey"
    stripe = finder.find(scene)
    assert stripe is not None
    assert np.sqrt(np.mean(errors_px(stripe, PLANE, POSE, 1) ** 2)) < 0.25


def test_an_overexposed_line_with_a_white_core_tells_its_colour_by_its_flanks() -> None:
    image = drawn(POSE).astype(np.int64)
    bleached = np.where(image[:, :, 2:] > 150, 255, image).astype(np.uint8)
    stripe = StripeFinder(CAMERA, True, "red").find(Scene(bleached, SURFACE))
    assert stripe is not None
    assert stripe.kept.sum() > 150


@pytest.mark.parametrize("seed", range(4))
def test_a_board_without_a_stripe_has_none(seed: int) -> None:
    T = board_poses(1, np.random.default_rng(seed))[0]
    scene = Scene(drawn(T, seed, laser=None), BoardSurface(CAMERA, T, BOARD))
    for along in (True, False):
        assert all(StripeFinder(CAMERA, along, channel).find(scene) is None for channel in (*CHANNELS, "grey"))


def test_the_stripe_on_the_print_wins_over_a_longer_one_on_the_table() -> None:
    rng = np.random.default_rng(1)
    columns = np.arange(640.0)
    v = np.where((columns > 250) & (columns < 350), 200.0, 206.0) + 0.1 * rng.normal(size=640)
    pixels = np.column_stack([columns, v])
    longest = fit_stripe_line(CAMERA, pixels)
    sure = fit_stripe_line(CAMERA, pixels, (columns > 250) & (columns < 350))
    assert longest is not None
    assert sure is not None
    assert longest.inliers[:200].mean() > 0.9
    assert sure.inliers[251:350].mean() > 0.95
    assert sure.inliers[:200].sum() == 0


def test_points_whose_width_an_edge_of_the_print_cuts_are_not_used() -> None:
    pixels = stripe_pixels(CAMERA, PLANE, POSE, 400)
    clear = SURFACE.clear(pixels, 4.0, 1)
    on_board = SURFACE._on_board(pixels)
    black = SURFACE._black(on_board)
    assert 0.3 < clear.mean() < 1
    # At least one of the two neighbours of a change of colour is cut.
    changes = np.flatnonzero(black[1:] != black[:-1])
    assert len(changes) >= 3
    assert clear[black].any()
    assert clear[~black].any()


def test_neighbours_that_err_together_are_counted_as_one() -> None:
    rng = np.random.default_rng(0)
    white = rng.normal(size=2000)
    smooth = np.convolve(rng.normal(size=2000), np.ones(20) / 20, "same")
    assert correlation_length(white) < 1.5
    assert 12 < correlation_length(smooth) < 30


def test_the_real_sensor_with_its_laser_off_shows_no_stripe(shared_data: Path) -> None:
    folder = shared_data / "blaser_calibration" / "640_v1_laser_off"
    scenes = [Scene(np.asarray(cv2.imread(str(path)), np.uint8)) for path in sorted(folder.glob("*.png"))]
    assert len(scenes) == 9
    finders = [StripeFinder(CAMERA, along, channel) for along in (True, False) for channel in ("red", "blue", "grey")]
    assert [finder.find(scene) for finder in finders for scene in scenes] == [None] * 54


def test_the_real_sensor_shows_its_stripe_in_every_image(shared_data: Path) -> None:
    folder = shared_data / "blaser_calibration" / "640_unified"
    scenes = [Scene(np.asarray(cv2.imread(str(path)), np.uint8)) for path in sorted(folder.glob("*.png"))]
    found = [StripeFinder(CAMERA, True, "red").find(scene) for scene in scenes]
    assert sum(stripe is not None for stripe in found) >= 24
