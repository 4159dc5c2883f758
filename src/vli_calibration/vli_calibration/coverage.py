"""Where the corners were: how much of the image, which distances, which tilts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vli_calibration.camera_fit import FittedView
from vli_common.arrays import FloatArray, IntArray

_CELLS = (8, 6)
_TILTED_DEG = 15.0


@dataclass(frozen=True, slots=True)
class Coverage:
    """What the views have in common with all that could be seen.

    Args:
        counts: (6, 8) corners in each cell of the image.
        reach: distance of the outermost corner from the image's middle over that of the image's own corner.
        distances_m: (V,) distance of the board's middle, metres.
        tilts_deg: (V,) angle between the board's normal and the line of sight's axis.
        tilted_about_x, tilted_about_y: views tilted by 15° or more about the image's horizontal and vertical axis.
    """

    counts: IntArray
    reach: float
    distances_m: FloatArray
    tilts_deg: FloatArray
    tilted_about_x: int
    tilted_about_y: int

    @property
    def share(self) -> float:
        """Share of the image's cells that hold a corner."""
        return float((self.counts > 0).mean())

    @property
    def empty_side(self) -> str | None:
        """The side of the image with the fewest cells that hold a corner, in words; None where each has half of them or more."""
        filled = self.counts > 0
        shares = {
            "left": filled[:, :2].mean(),
            "right": filled[:, -2:].mean(),
            "upper": filled[:2].mean(),
            "lower": filled[-2:].mean(),
        }
        side = min(shares, key=lambda name: float(shares[name]))
        return side if shares[side] < 0.5 else None


def coverage(views: Sequence[FittedView], points: FloatArray, resolution: tuple[int, int]) -> Coverage:
    """Return the coverage of the kept corners.

    Args:
        views: of a fit.
        points: (N, 3) of the target.
        resolution: width and height, pixels.
    """
    pixels = np.vstack([view.detection.pixels[view.kept] for view in views])
    size = np.array(resolution, dtype=np.float64)
    columns, rows = _CELLS
    cell = np.clip(((pixels + 0.5) / size * _CELLS).astype(int), 0, np.array(_CELLS) - 1)
    counts = np.bincount(cell[:, 1] * columns + cell[:, 0], minlength=columns * rows).reshape(rows, columns)
    middle = (size - 1) / 2
    reach = np.linalg.norm(pixels - middle, axis=1).max() / np.linalg.norm(middle + 0.5)
    poses = np.array([view.T_cam_board for view in views])
    centres = poses[:, :3, :3] @ points.mean(axis=0) + poses[:, :3, 3]
    normals = poses[:, :3, 2]
    about_x, about_y = np.degrees(np.arctan2(normals[:, 1], normals[:, 2])), np.degrees(np.arctan2(normals[:, 0], normals[:, 2]))
    return Coverage(
        counts.astype(np.int64),
        float(reach),
        np.linalg.norm(centres, axis=1),
        np.degrees(np.arccos(np.clip(normals[:, 2], -1, 1))),
        int((np.abs(about_x) >= _TILTED_DEG).sum()),
        int((np.abs(about_y) >= _TILTED_DEG).sum()),
    )
