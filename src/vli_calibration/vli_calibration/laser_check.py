"""How far to trust a calibration: the stripe on a flat board, triangulated with it, against the board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vli_calibration.board_surface import BoardSurface
from vli_calibration.boards import Target
from vli_calibration.laser_model import LaserPlane, stripe_points
from vli_calibration.laser_scenes import LaserScene, look_at, rejections, require_boards, require_stripes
from vli_calibration.laser_table import triangulated
from vli_calibration.types import CalibrationImage, Rejection
from vli_common.arrays import FloatArray
from vli_common.camera import CameraModel
from vli_common.errors import InputError

LEAST_CHECKED = 1
_LEAST_POINTS = 10
_MAD_SIGMA = 1.4826
"""Standard deviation over median absolute deviation, of Gaussian errors; neighbours err together: none is averaged away."""
_OTHER_SURFACE_SIGMAS = 3.0
_BESIDE = "too little of the stripe is seen on the print; what is beside it may be another surface"


@dataclass(frozen=True)
class CheckedImage:
    """One image's stripe.

    Args:
        name: of the image.
        depths: (M,) z of the triangulated points, metres.
        errors: (M,) triangulated depth less the board's, metres.
        flatness: (M,) distances along the board's normal from a straight line, metres: noise and bends, whatever the offset.
    """

    name: str
    depths: FloatArray
    errors: FloatArray
    flatness: FloatArray

    @property
    def bias_m(self) -> float:
        """Mean depth error."""
        return float(self.errors.mean())


@dataclass(frozen=True)
class LaserCheck:
    """All images that show board and stripe, and those that do not, with reasons."""

    images: tuple[CheckedImage, ...]
    rejected: tuple[Rejection, ...]
    scenes: tuple[LaserScene, ...]

    @property
    def depths(self) -> FloatArray:
        """(ΣM,) of all points, metres."""
        return np.concatenate([image.depths for image in self.images])

    @property
    def errors(self) -> FloatArray:
        """(ΣM,) depth errors of all points, metres."""
        return np.concatenate([image.errors for image in self.images])

    @property
    def flatness_rms_m(self) -> float:
        """RMS over all points of what is left after each image's mean offset and tilt along the stripe are taken off."""
        return float(np.sqrt(np.mean(np.concatenate([image.flatness for image in self.images]) ** 2)))

    @property
    def bias_m(self) -> float:
        """Mean depth error of all images, each counted alike."""
        return float(np.mean([image.bias_m for image in self.images]))

    @property
    def error_rms_m(self) -> float:
        """RMS depth error over all points."""
        return float(np.sqrt(np.mean(self.errors**2)))


def check_laser(images: Sequence[CalibrationImage], target: Target, camera: CameraModel, plane: LaserPlane) -> LaserCheck:
    """Triangulate the stripe of every image, eq. (1), and compare with the board's pose from its corners.

    What lies on the print decides: beside it the stripe may be on a table below the board, and speak against a good plane.

    Raises:
        InputError: no board, or no stripe on one, in any image.
    """
    scenes, _ = look_at(images, target, camera)
    require_boards(scenes, target)
    require_stripes(scenes, LEAST_CHECKED)
    checked = tuple(image for scene in scenes if (image := _checked(scene, target, camera, plane)) is not None)
    if not checked:
        raise InputError(
            f"in none of {len(scenes)} images the stripe crosses the print of the board; let it, and take new images"
        )
    names = {image.name for image in checked}
    beside = [Rejection(scene.name, _BESIDE) for scene in scenes if scene.has_both and scene.name not in names]
    return LaserCheck(checked, (*rejections(scenes), *beside), tuple(scenes))


def _checked(scene: LaserScene, target: Target, camera: CameraModel, plane: LaserPlane) -> CheckedImage | None:
    if scene.board is None or scene.stripe is None:
        return None
    pixels = scene.stripe.pixels[scene.stripe.kept]
    on_print = BoardSurface(camera, scene.board.T_cam_board, target).on_print(pixels)
    if on_print.sum() < _LEAST_POINTS:
        return None
    points = triangulated(camera, plane, pixels)
    errors = points[:, 2] - stripe_points(camera, scene.board.T_cam_board, pixels)[:, 2]
    if _differ(errors[on_print], errors[~on_print]):
        points, errors = points[on_print], errors[on_print]
    return CheckedImage(scene.name, points[:, 2], errors, _flatness(points, scene.board.T_cam_board))


def _differ(board: FloatArray, beside: FloatArray) -> bool:
    """Return True where errors beside the print (N,) are another surface's: their median is far off that on the print (M,)."""
    middle = float(np.median(board))
    sigma = _MAD_SIGMA * float(np.median(np.abs(board - middle)))
    return len(beside) > 0 and abs(float(np.median(beside)) - middle) > _OTHER_SURFACE_SIGMAS * sigma


def _flatness(points: FloatArray, T_cam_board: FloatArray) -> FloatArray:
    """Return distances (M,) along the board's normal, a straight line taken off: along a line a plane leaves no more."""
    height = (points - T_cam_board[:3, 3]) @ T_cam_board[:3, 2]
    along = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
    position = (points - points.mean(axis=0)) @ along
    result: FloatArray = height - np.polyval(np.polyfit(position, height, 1), position)
    return result
