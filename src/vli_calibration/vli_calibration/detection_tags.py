"""Boards of tags: Kalibr's AprilGrid and ChArUco, by OpenCV's aruco module; any part of the board will do."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from vli_calibration.boards import APRILTAG_BORDER_CELLS, AprilGrid, CharucoBoard
from vli_calibration.contrast import equalised, scaled
from vli_calibration.subpixel import board_grey, nearest_neighbour_px, refine
from vli_calibration.types import Detection
from vli_common.arrays import AnyArray, BoolArray, ByteArray, FloatArray, IntArray

_KALIBR_TURN = 2
"""OpenCV's corner j of a tag as Kalibr prints it is the printed corner (j + 2) % 4."""
_BORDERS = (APRILTAG_BORDER_CELLS, 1)
_NEIGHBOURS = 4
_MISPLACED_OF_TAG = 0.3
_SMALL_PX = 800
_LEAST_CHARUCO = 4


def detect_aprilgrid(target: AprilGrid, pixels: ByteArray) -> Detection | str:
    """Return the corners of the tags, or in words why there are none.

    Tags with Kalibr's double frame are looked for first, then those with a single one; how they are turned on the sheet is told
    by their places. A tag that does not sit where the ones round it say is left out.

    Args:
        target: what to look for.
        pixels: (H, W, 3) BGR or (H, W) grey.
    """
    grey = board_grey(pixels)
    ids, corners = _most_tags(grey, target.columns * target.rows)
    if not len(ids):
        return "no tag of the family 36h11 to be seen"
    known = ids < target.columns * target.rows
    if not known.any():
        return f"tags {ids.min()} to {ids.max()} to be seen, the grid has 0 to {target.columns * target.rows - 1}"
    ids, corners = ids[known], corners[known]
    corners = np.roll(corners, _turn(target, ids, corners), axis=1)
    placed = _well_placed(target, ids, corners)
    if not placed.any():
        return f"{len(ids)} tags to be seen, but not in the places of '{target.spec}'; check the order of their numbers"
    ids, corners = ids[placed], corners[placed]
    side = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min(axis=1)
    rows = (4 * ids[:, None] + np.arange(4)).ravel()
    refined, stayed = refine(grey, corners.reshape(-1, 2), np.repeat(side * min(1.0, target.gap), 4))
    return _detection(rows, refined, stayed)


def detect_charuco(target: CharucoBoard, pixels: ByteArray) -> Detection | str:
    """Return the inner corners, or in words why there are none; boards drawn by OpenCV before 4.6 are known too.

    Args:
        target: what to look for.
        pixels: (H, W, 3) BGR or (H, W) grey.
    """
    grey = board_grey(pixels)
    corners, rows, markers = _most_charuco(target, grey)
    if len(rows) < _LEAST_CHARUCO:
        if not markers:
            return f"no marker of {target.dictionary} to be seen"
        return f"{markers} markers of {target.dictionary} to be seen, but only {len(rows)} corners between them"
    # The markers' own corners must stay out of the window.
    clear = (target.square - target.marker) / 2 / target.square / 0.3
    refined, stayed = refine(grey, corners, nearest_neighbour_px(corners) * min(1.0, clear))
    return _detection(rows, refined, stayed)


def _detection(rows: IntArray, pixels: FloatArray, stayed: BoolArray) -> Detection:
    order = np.argsort(rows[stayed])
    return Detection(rows[stayed][order].astype(np.int64), pixels[stayed][order])


def _attempts(grey: ByteArray) -> Iterator[tuple[ByteArray, float]]:
    """Yield image and scale: as it is, with even contrast, and larger where it is small."""
    yield grey, 1.0
    yield equalised(grey), 1.0
    factor = 2.0 if max(grey.shape) <= _SMALL_PX else 0.5
    yield equalised(scaled(grey, factor)), factor


def _most_tags(grey: ByteArray, enough: int) -> tuple[IntArray, FloatArray]:
    """Return ids (T,) and corners (T, 4, 2) of the attempt that saw most, each id once; ``enough`` ends the search."""
    best_ids, best = np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2))
    for border in _BORDERS:
        detector = _tag_detector(border)
        for image, scale in _attempts(grey):
            if len(best_ids) >= enough:
                break
            found, ids, _ = detector.detectMarkers(image)
            if not found:
                continue
            unique, first = np.unique(ids.ravel(), return_index=True)
            if len(unique) > len(best_ids):
                best_ids = unique.astype(np.int64)
                best = (np.array(found).reshape(-1, 4, 2)[first].astype(np.float64) + 0.5) / scale - 0.5
        if len(best_ids):
            break
    return best_ids, best


def _tag_detector(border: int) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border
    parameters.adaptiveThreshWinSizeMax = 43
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), parameters)


def _turn(target: AprilGrid, ids: IntArray, corners: FloatArray) -> int:
    """Return by how many corners OpenCV's order is to be rolled; Kalibr's where a single tag cannot tell."""
    if len(ids) < 2:
        return _KALIBR_TURN
    errors = []
    for turn in range(4):
        places = _places(target, ids).reshape(-1, 2)
        pixels = np.roll(corners, turn, axis=1).reshape(-1, 2)
        H, _ = cv2.findHomography(places, pixels, cv2.LMEDS)
        errors.append(np.inf if H is None else float(np.median(_misses(H, places, pixels))))
    return int(np.argmin(errors))


def _well_placed(target: AprilGrid, ids: IntArray, corners: FloatArray) -> BoolArray:
    """Return which tags (T,) sit where their nearest neighbours on the board predict them."""
    if len(ids) < 2:
        return np.ones(len(ids), dtype=bool)
    places = _places(target, ids)
    side = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    good = np.ones(len(ids), dtype=bool)
    for i in range(len(ids)):
        distance = np.linalg.norm(places[:, 0] - places[i, 0], axis=1)
        near = np.argsort(distance)[1 : 1 + _NEIGHBOURS]
        H, _ = cv2.findHomography(places[near].reshape(-1, 2), corners[near].reshape(-1, 2), cv2.LMEDS)
        good[i] = H is not None and _misses(H, places[i], corners[i]).max() < _MISPLACED_OF_TAG * max(side[i], 1.0)
    return good


def _places(target: AprilGrid, ids: IntArray) -> FloatArray:
    """Return the corners (T, 4, 2) of the tags on the board, in units of a tag."""
    return target.points[(4 * ids[:, None] + np.arange(4)).ravel(), :2].reshape(-1, 4, 2) / target.tag


def _misses(H: AnyArray, places: FloatArray, pixels: FloatArray) -> FloatArray:
    predicted = cv2.perspectiveTransform(places.reshape(-1, 1, 2), H).reshape(-1, 2)
    lengths: FloatArray = np.linalg.norm(predicted - pixels.reshape(-1, 2), axis=1)
    return lengths


def _most_charuco(target: CharucoBoard, grey: ByteArray) -> tuple[FloatArray, IntArray, int]:
    """Return corners (K, 2), their rows (K,), and how many markers were seen, of the attempt that saw most corners."""
    corners, rows, markers = np.zeros((0, 2)), np.zeros(0, dtype=np.int64), 0
    for legacy in (False, True):
        board = cv2.aruco.CharucoBoard((target.columns, target.rows), target.square, target.marker, target.board.getDictionary())
        board.setLegacyPattern(legacy)
        detector = cv2.aruco.CharucoDetector(board)
        for image, scale in _attempts(grey):
            if len(rows) == len(target.points):
                break
            found, ids, _, marker_ids = detector.detectBoard(image)
            markers = max(markers, 0 if marker_ids is None else len(marker_ids))
            if ids is not None and len(ids) > len(rows):
                rows = ids.ravel().astype(np.int64)
                corners = (found.reshape(-1, 2).astype(np.float64) + 0.5) / scale - 0.5
        if len(rows) >= _LEAST_CHARUCO or not markers:
            break
    return corners, rows, markers
