"""The flat sheet that a board is printed on, as the image shows it: where a stripe can lie, and where the print disturbs it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vli_calibration.boards import Target
from vli_calibration.laser_model import stripe_points
from vli_common.arrays import BoolArray, FloatArray
from vli_common.camera import CameraModel
from vli_common.geometry import inverse, transform

SHEET_MARGIN = 1.0
"""How far beyond the print the sheet is taken to be flat, as a share of the print's shorter side."""


@dataclass(frozen=True)
class BoardSurface:
    """A board in front of the camera.

    The sheet is taken to go on flat round the print, for its shorter side in every direction: the paper, and the table it lies
    on. What lies off that plane shows as a break in the stripe, or as an image that disagrees with the others.

    Args:
        camera: with its lens.
        T_cam_board: (4, 4).
        target: what is printed.
    """

    camera: CameraModel
    T_cam_board: FloatArray
    target: Target

    @property
    def square_px(self) -> float:
        """Side of a square in the image where the board is farthest and most foreshortened, pixels."""
        points = transform(self.T_cam_board, self.target.points)
        cosine = abs(float(points.mean(axis=0) @ self.T_cam_board[:3, 2])) / float(np.linalg.norm(points.mean(axis=0)))
        return self.camera.focal_px * self.target.spacing * cosine / float(points[:, 2].max())

    def clear(self, pixels: FloatArray, half_px: float, axis: int) -> BoolArray:
        """Return which points (N,) lie on the sheet, with one colour of print under the line's width across the stripe.

        An edge under the line reflects one side of it more than the other and shifts its centre.

        Args:
            pixels: (N, 2) raw.
            half_px: half the width that the line may have.
            axis: image axis across the stripe, 0 (u) or 1 (v).
        """
        step = half_px * np.eye(2)[axis]
        at, below, above = (self._on_board(pixels + shift) for shift in (0.0, -step, step))
        colour = self._black(at)
        clear: BoolArray = self._inside(at, SHEET_MARGIN) & (self._black(below) == colour) & (self._black(above) == colour)
        return clear

    def on_print(self, pixels: FloatArray) -> BoolArray:
        """Return which points (N,) lie within the print, and so on the board for certain."""
        return self._inside(self._on_board(pixels), 0.0)

    def _on_board(self, pixels: FloatArray) -> FloatArray:
        """Return board coordinates x, y (N, 2) of raw pixels; NaN where the ray does not meet the board."""
        points = stripe_points(self.camera, self.T_cam_board, pixels)
        points[~(points[:, 2] > 0)] = np.nan
        return transform(inverse(self.T_cam_board), points)[:, :2]

    def _inside(self, xy: FloatArray, share: float) -> BoolArray:
        """Return which board coordinates (N, 2) lie within the print, grown by a share of its shorter side."""
        x0, y0, x1, y1 = self.target.extent
        margin = share * min(x1 - x0, y1 - y0)
        lowest, highest = np.array([x0, y0]) - margin, np.array([x1, y1]) + margin
        return np.asarray(((xy >= lowest) & (xy <= highest)).all(axis=1))

    def _black(self, xy: FloatArray) -> BoolArray:
        x0, y0, x1, y1 = self.target.rectangles.T
        x, y = xy[:, :1], xy[:, 1:]
        black: BoolArray = ((x >= x0) & (x < x1) & (y >= y0) & (y < y1)).any(axis=1)
        return black
