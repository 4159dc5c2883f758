"""Targets: the texts that describe them, where their corners are, what is printed."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from vli_calibration.targets import AprilGrid, CharucoBoard, Chessboard, parse_target
from vli_common.errors import InputError

TEXTS = ["chessboard:9x6:0.005", "charuco:7x5:0.01:0.007:DICT_5X5_100", "aprilgrid:6x5:0.022:0.3"]


@pytest.mark.parametrize("text", TEXTS)
def test_a_target_is_described_by_the_text_that_made_it(text: str) -> None:
    target = parse_target(text)
    assert target.spec == text
    assert parse_target(target.spec) == target


def test_corners_of_a_chessboard_go_row_by_row_from_the_first() -> None:
    board = parse_target("chessboard:9x6:0.005")
    assert board.points.shape == (54, 3)
    assert board.points[0] == pytest.approx([0, 0, 0])
    assert board.points[8] == pytest.approx([0.040, 0, 0])
    assert board.points[9] == pytest.approx([0, 0.005, 0])
    assert not board.symmetric
    assert parse_target("chessboard:8x6:0.005").symmetric


def test_kalibrs_grid_has_its_first_tag_at_the_bottom_left() -> None:
    grid = parse_target("aprilgrid:6x5:0.02:0.5")
    assert grid.points.shape == (120, 3)
    assert grid.points[:4, :2] == pytest.approx(np.array([[0, 0], [0.02, 0], [0.02, 0.02], [0, 0.02]]))
    assert grid.points[4] == pytest.approx([0.03, 0, 0])
    assert grid.points[4 * 6] == pytest.approx([0, -0.03, 0])


@pytest.mark.parametrize("text", [*TEXTS, "charuco:8x6:0.01:0.0075:4X4_50"])
def test_black_rectangles_never_overlap(text: str) -> None:
    target = parse_target(text)
    pixels, _ = target.raster(20 / target.spacing)
    area = ((target.rectangles[:, 2:] - target.rectangles[:, :2]).prod(axis=1)).sum()
    printed = (255 - pixels.astype(np.float64)).sum() / 255 / (20 / target.spacing) ** 2
    assert printed == pytest.approx(area, rel=1e-3)


@pytest.mark.parametrize("text", TEXTS)
def test_the_first_pixel_of_a_raster_is_where_it_says(text: str) -> None:
    target = parse_target(text)
    scale = 1234.5 / target.spacing / 50
    pixels, first = target.raster(scale)
    black = 255 - pixels.astype(np.float64)
    v, u = np.indices(pixels.shape)
    centre = first + np.array([(black * u).sum(), (black * v).sum()]) / black.sum() / scale
    area = (target.rectangles[:, 2:] - target.rectangles[:, :2]).prod(axis=1)
    expected = ((target.rectangles[:, :2] + target.rectangles[:, 2:]) / 2 * area[:, None]).sum(axis=0) / area.sum()
    assert centre == pytest.approx(expected, abs=1e-3 * target.spacing)


@pytest.mark.parametrize("text", TEXTS)
def test_a_raster_has_a_white_margin_of_a_square(text: str) -> None:
    target = parse_target(text)
    pixels, _ = target.raster(20 / target.spacing)
    assert pixels[:19].min() == pixels[-19:].min() == pixels[:, :19].min() == pixels[:, -19:].min() == 255
    assert pixels.min() == 0


def test_a_charuco_board_is_drawn_as_opencv_draws_it() -> None:
    board = parse_target("charuco:7x5:0.01:0.007:DICT_5X5_100")
    assert isinstance(board, CharucoBoard)
    pixels, _ = board.raster(20_000)
    drawn = board.board.generateImage((1400, 1000), marginSize=0)
    assert np.array_equal(pixels[200:-200, 200:-200], drawn)
    assert board.points[:, :2] + 0.01 == pytest.approx(np.array(board.board.getChessboardCorners())[:, :2], abs=1e-6)


def test_a_tag_of_the_grid_has_kalibrs_double_frame_and_the_code_of_its_authors() -> None:
    grid = parse_target("aprilgrid:1x1:0.1:0.2")
    pixels, first = grid.raster(100)
    cells = (pixels[12:22, 12:22] > 127).astype(int)
    assert first == pytest.approx([-0.115, -0.115])  # margin of a tag, a black square, half a pixel
    assert not cells[:2].any()
    assert not cells[-2:].any()
    # Tag 0 of the family is 0xd5d628584, its bits row by row, the highest first.
    code = int("".join(str(bit) for bit in cells[2:8, 2:8].ravel()), 2)
    assert code == 0xD5D628584


def test_texts_in_other_spelling_are_understood() -> None:
    assert parse_target("Chessboard:9X6:5e-3") == Chessboard(9, 6, 0.005)
    assert parse_target("charuco:7x5:0.01:0.007:dict_4x4_50") == CharucoBoard(7, 5, 0.01, 0.007, "DICT_4X4_50")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "unknown kind ''"),
        ("circles:4x5:0.01", "unknown kind 'circles', expected chessboard:COLSxROWS:SQUARE"),
        ("chessboard:9x6", "has 1 fields after 'chessboard', expected chessboard:COLSxROWS:SQUARE"),
        ("chessboard:9:0.005", "has the size '9', expected COLSxROWS such as 9x6"),
        ("chessboard:2x6:0.005", "has the size '2x6'"),
        ("chessboard:-9x6:0.005", "has the size '-9x6'"),
        ("chessboard:9x6:abc", "has the square 'abc', expected a number"),
        ("chessboard:9x6:nan", "has the square 'nan', expected a number"),
        ("chessboard:9x6:-0.005", "square of '-0.005', expected metres"),
        ("chessboard:9x6:5", "is a board of '45' m, expected at most 5; lengths are in metres"),
        ("chessboard:9x6:30", "square of '30', expected metres"),
        ("charuco:7x5:0.01:0.01:4X4_50", "has a marker of '0.01' m, expected less than its square"),
        ("charuco:7x5:0.01:0.007:5X5_77", "unknown dictionary '5X5_77'"),
        ("charuco:20x20:0.01:0.007:4X4_50", "needs '200' markers, 'DICT_4X4_50' has 50"),
        ("aprilgrid:6x6:0.02:0", "has the spacing '0', expected a ratio"),
        ("aprilgrid:30x30:0.02:0.3", "needs '900' tags, the family 36h11 has 587"),
    ],
)
def test_a_malformed_text_is_one_line_that_says_what_is_valid(text: str, message: str) -> None:
    with pytest.raises(InputError) as error:
        parse_target(text)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_kalibrs_files_are_read(tmp_path: Path) -> None:
    path = tmp_path / "target.yaml"
    path.write_text("target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 5\ntagSize: 0.022\ntagSpacing: 0.3\n")
    assert parse_target(str(path)) == AprilGrid(6, 5, 0.022, 0.3)
    path.write_text("target_type: 'checkerboard'\ntargetCols: 9\ntargetRows: 6\nrowSpacingMeters: 0.03\ncolSpacingMeters: 0.03\n")
    assert parse_target(str(path)) == Chessboard(9, 6, 0.03)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "does not exist, expected chessboard:"),
        ("a: [", "cannot be read"),
        ("- 1\n", "holds 'list'"),
        ("target_type: circlegrid\n", "has the target_type 'circlegrid', expected aprilgrid or checkerboard"),
        ("target_type: aprilgrid\ntagRows: 5\n", "has 'None' for 'tagCols', expected a number"),
        (
            "target_type: aprilgrid\ntagCols: 6\ntagRows: 5\ntagSize: big\ntagSpacing: 0.3\n",
            "has the tag 'big', expected a number",
        ),
        (
            "target_type: checkerboard\ntargetCols: 9\ntargetRows: 6\nrowSpacingMeters: 0.03\ncolSpacingMeters: 0.02\n",
            "expected rowSpacingMeters = colSpacingMeters",
        ),
    ],
)
def test_a_damaged_kalibr_file_is_one_line(tmp_path: Path, content: str | None, message: str) -> None:
    path = tmp_path / "target.yaml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(InputError) as error:
        parse_target(str(path))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_opencvs_own_detector_finds_the_drawn_grid_in_every_place() -> None:
    grid = parse_target("aprilgrid:4x3:0.02:0.3")
    pixels, first = grid.raster(4000)
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = 2
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(pixels)
    assert sorted(ids.ravel().tolist()) == list(range(12))
    for index, found in zip(ids.ravel(), corners, strict=True):
        printed = (grid.points[4 * index : 4 * index + 4, :2] - first) * 4000
        assert np.roll(found.reshape(4, 2), 2, axis=0) == pytest.approx(printed, abs=2.0)
