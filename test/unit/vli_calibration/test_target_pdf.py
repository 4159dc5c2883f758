"""The printed target: its drawing has the size that the text says, in the PDF's own units."""

from __future__ import annotations

import re
import zlib

import numpy as np
import pytest

from vli_calibration.target_pdf import PAGES_MM, make_sheet
from vli_calibration.targets import parse_target
from vli_common.arrays import FloatArray
from vli_common.errors import InputError

_POINT_MM = 25.4 / 72

TARGETS = ["chessboard:9x6:0.005", "charuco:7x5:0.01:0.007:DICT_5X5_100", "aprilgrid:6x6:0.022:0.3"]


def page_and_rectangles(data: bytes) -> tuple[tuple[float, float], FloatArray]:
    """Read a PDF: the size of its page and all rectangles that are filled as paths (M, 4), millimetres from the upper left."""
    box = re.search(rb"/MediaBox \[ ?([\d. ]+) ?\]", data)
    assert box is not None
    _, _, width, height = (float(number) * _POINT_MM for number in box.group(1).split())
    contents = b""
    for match in re.finditer(rb"stream\r?\n(.*?)\r?\nendstream", data, re.DOTALL):
        try:
            text = zlib.decompress(match.group(1))
        except zlib.error:
            continue
        if b" m\n" in text and b" l\n" in text and b"BT" in text:
            contents = text
    number = rb"(-?[\d.]+)"
    point = number + rb" " + number
    found = re.findall(point + rb" m\n" + point + rb" l\n" + point + rb" l\n" + point + rb" l\nh\n", contents)
    corners = np.array(found, dtype=np.float64).reshape(-1, 4, 2) * _POINT_MM
    corners[:, :, 1] = height - corners[:, :, 1]
    return (width, height), np.hstack([corners.min(axis=1), corners.max(axis=1)])


@pytest.mark.parametrize("text", TARGETS)
def test_the_pattern_is_drawn_at_true_scale(text: str) -> None:
    target = parse_target(text)
    sheet = make_sheet(target)
    page, drawn = page_and_rectangles(sheet.data)
    assert page == pytest.approx(sheet.size_mm, abs=0.01)
    pattern = drawn[: len(target.rectangles)]
    expected = 1e3 * target.rectangles
    assert pattern[:, 2:] - pattern[:, :2] == pytest.approx(expected[:, 2:] - expected[:, :2], abs=1e-3)
    offset = pattern[:, :2] - expected[:, :2]
    assert np.ptp(offset, axis=0).max() < 1e-3


@pytest.mark.parametrize("text", TARGETS)
def test_the_ruler_has_a_tick_every_millimetre_and_the_stated_length(text: str) -> None:
    target = parse_target(text)
    sheet = make_sheet(target)
    _, drawn = page_and_rectangles(sheet.data)
    ticks = drawn[len(target.rectangles) : -1]
    places = (ticks[:, 0] + ticks[:, 2]) / 2
    assert np.diff(places) == pytest.approx(1.0, abs=1e-3)
    assert places[-1] - places[0] == pytest.approx(sheet.ruler_mm, abs=1e-3)
    assert sheet.ruler_mm >= 100


@pytest.mark.parametrize("text", TARGETS)
def test_nothing_overlaps_and_all_is_on_the_paper(text: str) -> None:
    target = parse_target(text)
    sheet = make_sheet(target)
    _, drawn = page_and_rectangles(sheet.data)
    assert drawn.min() >= 5
    assert (drawn[:, 2:] <= np.array(sheet.size_mm) - 5).all()
    pattern, ruler = drawn[: len(target.rectangles)], drawn[len(target.rectangles) :]
    assert pattern[:, 3].max() + 4 < ruler[:, 1].min()


@pytest.mark.parametrize(
    ("text", "page"),
    [
        ("chessboard:9x6:0.005", "A4"),
        ("chessboard:9x6:0.03", "A3"),
        ("chessboard:9x6:0.05", "A2"),
        ("aprilgrid:6x6:0.022:0.3", "A4"),
        ("aprilgrid:6x6:0.088:0.3", "A0"),
    ],
)
def test_the_smallest_iso_page_that_holds_the_board_is_chosen(text: str, page: str) -> None:
    assert make_sheet(parse_target(text)).page == page


def test_a_page_by_name_or_size_is_taken_as_given_and_turned_where_that_fits() -> None:
    board = parse_target("chessboard:9x6:0.025")
    assert make_sheet(board, "a2").size_mm == PAGES_MM["a2"]
    assert make_sheet(board, "250x300").size_mm == (300, 250)
    with pytest.raises(InputError, match=r"needs '\d+ x \d+' mm of paper, more than 'letter'"):
        make_sheet(board, "letter")
    with pytest.raises(InputError, match="page 'a9' is unknown, expected a4"):
        make_sheet(board, "a9")
    with pytest.raises(InputError, match="page '10x10' is unknown"):
        make_sheet(board, "10x10")
    with pytest.raises(InputError, match="more than A0"):
        make_sheet(parse_target("chessboard:9x6:0.2"))


def test_the_same_target_gives_the_same_file() -> None:
    board = parse_target("chessboard:9x6:0.005")
    assert make_sheet(board).data == make_sheet(board).data
