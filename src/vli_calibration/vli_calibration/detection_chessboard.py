"""Chessboards in images that were taken to show a laser stripe: dim, blurred, glaring.

The corners come from cv2.findChessboardCornersSB (Duda and Frese, "Accurate Detection and Localization of Checkerboard Corners
for Calibration", BMVC 2018), which wants even contrast and squares of a middling size; so it is asked several times, the
cheapest first.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from vli_calibration.boards import Chessboard
from vli_calibration.contrast import equalised, flattened, scaled
from vli_calibration.subpixel import board_grey, nearest_neighbour_px, refine
from vli_calibration.types import Detection
from vli_common.arrays import ByteArray, FloatArray

_FIRST_SIDE_PX = 640
"""Longer side of the image in which a board is looked for first."""
_SMALLEST_GATE = (3, 3)
_CONTRAST_GREY = 12.0
_DARK_GREY = 25.0


def detect_chessboard(target: Chessboard, pixels: ByteArray) -> Detection | str:
    """Return the corners of the board, or in words why there are none.

    Corner 0 is the one with the black square beyond it; where both ends look alike (:attr:`Chessboard.symmetric`), the one that
    makes the board's x axis point to the right, or down if it points neither way.

    Args:
        target: what to look for.
        pixels: (H, W, 3) BGR or (H, W) grey.
    """
    grey = board_grey(pixels)
    found = _find(target, grey)
    if isinstance(found, str):
        return found
    corners = _oriented(target, grey, found)
    refined, stayed = refine(grey, corners, nearest_neighbour_px(corners))
    return Detection(np.flatnonzero(stayed).astype(np.int64), refined[stayed])


def seen_size(grey: ByteArray) -> tuple[int, int] | None:
    """Return columns and rows, the larger first, of whatever chessboard of 3 × 3 inner corners or more is there."""
    scale = min(1.0, _FIRST_SIDE_PX / max(grey.shape))
    for image in (equalised(scaled(grey, scale)), flattened(scaled(grey, scale))):
        ok, _, meta = cv2.findChessboardCornersSBWithMeta(image, _SMALLEST_GATE, flags=cv2.CALIB_CB_LARGER)
        if ok and meta is not None:
            return max(meta.shape[:2]), min(meta.shape[:2])
    return None


def _find(target: Chessboard, grey: ByteArray) -> FloatArray | str:
    """Return the corners (N, 2) in full-size pixels, in the finder's order, or why there are none.

    The expensive attempts are made only where some chessboard is seen.
    """
    longest = max(grey.shape)
    first = min(1.0, _FIRST_SIDE_PX / longest)
    corners = _first_found(target, _cheap_attempts(grey, first))
    if corners is not None:
        return corners
    size = seen_size(grey)
    if size is None:
        return _why_nothing(grey)
    if max(size) > max(target.columns, target.rows) or min(size) > min(target.columns, target.rows):
        return _why_not_this(target, size)
    corners = _first_found(target, _costly_attempts(grey, first))
    return _why_not_this(target, size) if corners is None else corners


def _first_found(target: Chessboard, attempts: Iterator[tuple[ByteArray, int, float]]) -> FloatArray | None:
    for image, flags, scale in attempts:
        ok, corners = cv2.findChessboardCornersSB(image, (target.columns, target.rows), flags=flags)
        if ok:
            full: FloatArray = (corners.reshape(-1, 2).astype(np.float64) + 0.5) / scale - 0.5
            return full
    return None


def _cheap_attempts(grey: ByteArray, first: float) -> Iterator[tuple[ByteArray, int, float]]:
    """Yield image, flags and scale."""
    yield equalised(scaled(grey, first)), 0, first
    yield flattened(scaled(grey, first)), 0, first


def _costly_attempts(grey: ByteArray, first: float) -> Iterator[tuple[ByteArray, int, float]]:
    second = min(2 * first, 1.0) if first < 1 else 2.0
    for scale in (first / 2, second):
        yield equalised(scaled(grey, scale)), 0, scale
        yield flattened(scaled(grey, scale)), 0, scale
    yield equalised(scaled(grey, first)), cv2.CALIB_CB_EXHAUSTIVE, first


def _oriented(target: Chessboard, grey: ByteArray, corners: FloatArray) -> FloatArray:
    """Return the corners (N, 2) in the order of the target's points."""
    grid = corners.reshape(target.rows, target.columns, 2)
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0:
        # A board seen from the front is never mirrored.
        grid = grid[:, ::-1]
    choices = [grid, grid[::-1, ::-1]]
    if target.columns == target.rows:
        turned = np.swapaxes(grid, 0, 1)[:, ::-1]
        choices += [turned, turned[::-1, ::-1]]
    darkness = np.array([_darkness_of_first(grey, choice) for choice in choices])
    # Where turning changes nothing, all are equally dark up to noise; where it does, the sign tells.
    fitting = [choice for choice, dark in zip(choices, darkness, strict=True) if dark > 0] or choices
    return max(fitting, key=_rightward).reshape(-1, 2)


def _rightward(grid: FloatArray) -> float:
    along = grid[0, -1] - grid[0, 0]
    return float(along[0] + 1e-3 * along[1])


def _darkness_of_first(grey: ByteArray, grid: FloatArray) -> float:
    """Return by how much the squares of corner 0's own colour are darker than the others, grey levels.

    The square between the first four corners lies diagonally across corner 0 from the one beyond it, and has its colour.
    """
    centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    pixel = np.clip(np.rint(centres).astype(int), 0, np.array(grey.shape[::-1]) - 1)
    values = grey[pixel[..., 1], pixel[..., 0]].astype(np.float64)
    row, column = np.indices(values.shape)
    even = (row + column) % 2 == 0
    return float(np.median(values[~even]) - np.median(values[even]))


def _why_nothing(grey: ByteArray) -> str:
    low, high = (float(level) for level in np.quantile(grey, (0.05, 0.95)))
    if high < _DARK_GREY:
        return f"too dark: 95 % of the image is below grey {high:.0f} of 255"
    if high - low < _CONTRAST_GREY:
        return f"no contrast: 90 % of the image lies within {high - low:.0f} of 255 grey levels"
    return "no chessboard pattern to be seen"


def _why_not_this(target: Chessboard, size: tuple[int, int]) -> str:
    wanted = max(target.columns, target.rows), min(target.columns, target.rows)
    if size == wanted:
        return "the board's corners are too blurred or covered to be numbered"
    return (
        f"{size[0]}x{size[1]} inner corners to be seen instead of {wanted[0]}x{wanted[1]}: "
        "another board, or part of it is out of the image or covered"
    )
