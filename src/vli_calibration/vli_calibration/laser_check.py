"""How far to trust a calibration: the stripe on a flat board, triangulated with it, against the board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vli_calibration.boards import Target
from vli_calibration.laser_model import LaserPlane, stripe_points
from vli_calibration.laser_scenes import LaserScene, look_at, rejections, require_boards, require_stripes
from vli_calibration.laser_table import triangulated
from vli_calibration.types import CalibrationImage, Rejection
from vli_common.arrays import FloatArray
from vli_common.camera import CameraModel

LEAST_CHECKED = 1


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

    Raises:
        InputError: no board, or no stripe on one, in any image.
    """
    scenes, _ = look_at(images, target, camera)
    require_boards(scenes, target)
    require_stripes(scenes, LEAST_CHECKED)
    checked = tuple(image for scene in scenes if (image := _checked(scene, camera, plane)) is not None)
    return LaserCheck(checked, tuple(rejections(scenes)), tuple(scenes))


def _checked(scene: LaserScene, camera: CameraModel, plane: LaserPlane) -> CheckedImage | None:
    if scene.board is None or scene.stripe is None:
        return None
    pixels = scene.stripe.pixels[scene.stripe.kept]
    points = triangulated(camera, plane, pixels)
    errors = points[:, 2] - stripe_points(camera, scene.board.T_cam_board, pixels)[:, 2]
    return CheckedImage(scene.name, points[:, 2], errors, _flatness(points, scene.board.T_cam_board))


def _flatness(points: FloatArray, T_cam_board: FloatArray) -> FloatArray:
    """Return distances (M,) along the board's normal, a straight line taken off: along a line a plane leaves no more."""
    height = (points - T_cam_board[:3, 3]) @ T_cam_board[:3, 2]
    along = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
    position = (points - points.mean(axis=0)) @ along
    result: FloatArray = height - np.polyval(np.polyfit(position, height, 1), position)
    return result
