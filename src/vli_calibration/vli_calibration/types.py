"""What the parts of the calibration hand to each other.

Metres, radians, raw pixels (OpenCV's convention). ``T_a_b`` maps points of frame b into frame a. The *board* frame has its
origin at the first corner, x along the columns, y along the rows, and z away from the viewer, so that a board seen from the
front has z pointing with the camera's.
"""

from __future__ import annotations

from dataclasses import dataclass

from vli_common.arrays import ByteArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class CalibrationImage:
    """One image, and what is known of it besides its pixels.

    Args:
        name: file name, or stamp in a bag; what tables and messages call it.
        pixels: (H, W, 3) uint8 BGR or (H, W) uint8 grey.
        stripe_pixels: the short exposure of the same scene with the laser on, where long and short come in pairs; None where one
            image has to show both.
        T_base_tool: (4, 4) pose of the arm, or None.
    """

    name: str
    pixels: ByteArray
    stripe_pixels: ByteArray | None = None
    T_base_tool: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class Detection:
    """Corners of the target found in one image.

    Args:
        ids: (K,) int64, rows of :attr:`vli_calibration.targets.Target.points`, ascending.
        pixels: (K, 2) float64, raw, refined to sub-pixel.
    """

    ids: IntArray
    pixels: FloatArray

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True)
class Rejection:
    """What was left out, and why, in words: an image by name, or corners or points of it."""

    name: str
    reason: str
