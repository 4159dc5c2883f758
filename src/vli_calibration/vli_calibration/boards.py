"""The boards that can be a target: where their corners are, and what is printed black.

Every target is black rectangles on white paper, which is all that the drawing, the simulator and the PDF need.
The board frame is the one of :mod:`vli_calibration.types`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from vli_common.arrays import BoolArray, ByteArray, FloatArray

APRILTAG_BORDER_CELLS = 2
"""Width of the black frame round the 6×6 code, in code cells, as Kalibr prints it (other programs: 1)."""
_APRILTAG_CODE_CELLS = 6


@dataclass(frozen=True)
class Target(ABC):
    """A flat target with numbered corners.

    Args:
        columns, rows: what the text on the command line counts: inner corners of a chessboard, squares of a ChArUco board,
            tags of an AprilGrid.
    """

    columns: int
    rows: int

    @property
    @abstractmethod
    def spec(self) -> str:
        """The text that :func:`vli_calibration.targets.parse_target` reads back into this target."""

    @property
    @abstractmethod
    def points(self) -> FloatArray:
        """Corners (N, 3), metres in the board frame, z = 0; a corner's id is its row."""

    @property
    @abstractmethod
    def rectangles(self) -> FloatArray:
        """What is black: disjoint (M, 4) rectangles x0, y0, x1, y1, metres in the board frame."""

    @property
    @abstractmethod
    def spacing(self) -> float:
        """Side of the squares (chessboard, ChArUco) or of the tags, metres: the scale of what is printed."""

    @property
    def symmetric(self) -> bool:
        """True where the board looks the same turned by 180°, so that one image cannot tell which end is which."""
        return False

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounding box x0, y0, x1, y1 of the whole pattern without its white margin, metres."""
        x0, y0 = self.rectangles[:, :2].min(axis=0)
        x1, y1 = self.rectangles[:, 2:].max(axis=0)
        return float(x0), float(y0), float(x1), float(y1)

    @property
    def margin(self) -> float:
        """White border that the detection needs round the pattern, metres."""
        return self.spacing

    def raster(self, pixels_per_metre: float) -> tuple[ByteArray, FloatArray]:
        """Return the print as grey (H, W) uint8, and board-frame (x, y) metres of the centre of its pixel (0, 0).

        A pixel's grey is the share of its area that is white, so that edges fall between pixels where they should.
        """
        x0, y0, x1, y1 = self.extent
        corner = np.array([x0 - self.margin, y0 - self.margin])
        width, height = (int(np.ceil((size + 2 * self.margin) * pixels_per_metre - 1e-6)) for size in (x1 - x0, y1 - y0))
        black = np.zeros((height, width))
        edges = (self.rectangles - np.tile(corner, 2)) * pixels_per_metre
        for left, top, right, bottom in edges:
            columns, share_x = _coverage(left, right)
            rows, share_y = _coverage(top, bottom)
            black[rows, columns] += np.outer(share_y, share_x)
        pixels = np.rint(255 * np.clip(1 - black, 0, 1)).astype(np.uint8)
        return pixels, corner + 0.5 / pixels_per_metre


@dataclass(frozen=True)
class Chessboard(Target):
    """A chessboard of ``columns`` × ``rows`` inner corners, numbered row by row.

    The square on the far side of corner 0 (the printed top left one) is black.

    Args:
        square: metres.
    """

    square: float

    @property
    def spec(self) -> str:
        """See :attr:`Target.spec`."""
        return f"chessboard:{self.columns}x{self.rows}:{self.square:g}"

    @cached_property
    def points(self) -> FloatArray:
        """See :attr:`Target.points`."""
        return _lattice(self.columns, self.rows, self.square)

    @cached_property
    def rectangles(self) -> FloatArray:
        """See :attr:`Target.rectangles`."""
        return self.square * (_black_squares(self.columns + 1, self.rows + 1) - 1.0)

    @property
    def spacing(self) -> float:
        """See :attr:`Target.spacing`."""
        return self.square

    @property
    def symmetric(self) -> bool:
        """See :attr:`Target.symmetric`; one even and one odd count give the two ends different colours."""
        return (self.columns + self.rows) % 2 == 0


@dataclass(frozen=True)
class CharucoBoard(Target):
    """A ChArUco board of ``columns`` × ``rows`` squares as OpenCV ≥ 4.6 draws it, its inner corners numbered row by row.

    Args:
        square, marker: sides, metres.
        dictionary: name in cv2.aruco, e.g. DICT_4X4_50.
    """

    square: float
    marker: float
    dictionary: str

    @property
    def spec(self) -> str:
        """See :attr:`Target.spec`."""
        return f"charuco:{self.columns}x{self.rows}:{self.square:g}:{self.marker:g}:{self.dictionary}"

    @cached_property
    def points(self) -> FloatArray:
        """See :attr:`Target.points`."""
        return _lattice(self.columns - 1, self.rows - 1, self.square)

    @cached_property
    def board(self) -> cv2.aruco.CharucoBoard:
        """The same board as OpenCV's detector wants it."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, dictionary)

    @cached_property
    def rectangles(self) -> FloatArray:
        """See :attr:`Target.rectangles`; markers sit in the white squares, row by row."""
        dictionary = self.board.getDictionary()
        cells = dictionary.markerSize + 2
        white = [(x, y) for y in range(self.rows) for x in range(self.columns) if (x + y) % 2 == 1]
        markers = [
            (_runs(cv2.aruco.generateImageMarker(dictionary, index, cells) == 0) * (self.marker / cells))
            + np.tile((np.array(place) - 1) * self.square + (self.square - self.marker) / 2, 2)
            for index, place in enumerate(white)
        ]
        return np.vstack([self.square * (_black_squares(self.columns, self.rows) - 1.0), *markers])

    @property
    def spacing(self) -> float:
        """See :attr:`Target.spacing`."""
        return self.square


@dataclass(frozen=True)
class AprilGrid(Target):
    """Kalibr's grid of 36h11 tags: tag 0 bottom left, numbers to the right and then up, black squares at the tags' corners.

    Corner ``4 i + j`` belongs to tag i: top left, top right, bottom right, bottom left as printed. The board frame starts at
    corner 0, so that rows further up have negative y.

    Args:
        tag: outer side of a tag's black frame, metres.
        gap: space between tags as a ratio of ``tag`` (Kalibr's tagSpacing).
    """

    tag: float
    gap: float

    @property
    def spec(self) -> str:
        """See :attr:`Target.spec`."""
        return f"aprilgrid:{self.columns}x{self.rows}:{self.tag:g}:{self.gap:g}"

    @cached_property
    def points(self) -> FloatArray:
        """See :attr:`Target.points`."""
        corners = self.tag * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        flat = (self._tag_origins[:, None] + corners).reshape(-1, 2)
        return np.column_stack([flat, np.zeros(len(flat))])

    @cached_property
    def rectangles(self) -> FloatArray:
        """See :attr:`Target.rectangles`."""
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        cells = _APRILTAG_CODE_CELLS + 2 * APRILTAG_BORDER_CELLS
        tags = []
        for index, origin in enumerate(self._tag_origins):
            marker = cv2.aruco.generateImageMarker(dictionary, index, cells, borderBits=APRILTAG_BORDER_CELLS)
            # OpenCV's picture of a 36h11 tag is upside down against the one of the tag's authors, which Kalibr prints.
            tags.append(_runs(np.rot90(marker, 2) == 0) * (self.tag / cells) + np.tile(origin, 2))
        pitch, gap = self.tag * (1 + self.gap), self.tag * self.gap
        x, y = np.meshgrid(np.arange(self.columns + 1), np.arange(self.rows + 1))
        corner = np.stack([x.ravel() * pitch - gap, self.tag - y.ravel() * pitch], axis=1)
        return np.vstack([*tags, np.hstack([corner, corner + gap])])

    @property
    def spacing(self) -> float:
        """See :attr:`Target.spacing`."""
        return self.tag

    @property
    def _tag_origins(self) -> FloatArray:
        """(tags, 2) top left corner of each tag."""
        x, y = np.meshgrid(np.arange(self.columns), -np.arange(self.rows))
        return (self.tag * (1 + self.gap) * np.stack([x.ravel(), y.ravel()], axis=1)).astype(np.float64)


def _lattice(columns: int, rows: int, square: float) -> FloatArray:
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return (square * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)).astype(np.float64)


def _black_squares(columns: int, rows: int) -> FloatArray:
    """Rectangles (M, 4) of unit squares with an even sum of column and row."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    corner = np.stack([x[(x + y) % 2 == 0], y[(x + y) % 2 == 0]], axis=1).astype(np.float64)
    return np.hstack([corner, corner + 1])


def _runs(black: BoolArray) -> FloatArray:
    """Rectangles (M, 4), in cells, of the black runs in each row of a marker; fewer and seamless along a row."""
    steps = np.diff(np.pad(black, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    (row, start), (_, end) = np.nonzero(steps == 1), np.nonzero(steps == -1)
    return np.stack([start, row, end, row + 1], axis=1).astype(np.float64)


def _coverage(start: float, end: float) -> tuple[slice, FloatArray]:
    """Return the pixels that the interval touches, and the share of each that it covers; pixel i is [i, i + 1)."""
    first, last = int(np.floor(start + 1e-9)), int(np.ceil(end - 1e-9))
    edges = np.arange(first, last + 1)
    return slice(first, last), np.minimum(edges[1:], end) - np.maximum(edges[:-1], start)
