"""One flat table through the arm: the whole chain of lens, laser plane, hand–eye and arm, checked on the surface itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vli_calibration.laser_model import LaserPlane
from vli_calibration.plane_fit import fit_plane_robust
from vli_common.arrays import FloatArray
from vli_common.camera import CameraModel
from vli_common.geometry import transform


@dataclass(frozen=True)
class TableCheck:
    """How flat the table comes out.

    Args:
        plane: of the table in the arm's base frame.
        names: of the images.
        distances: (M,) for each image: signed distance of its points from that plane, metres.
    """

    plane: LaserPlane
    names: tuple[str, ...]
    distances: tuple[FloatArray, ...]

    @property
    def rms_m(self) -> float:
        """RMS distance over all points of all images."""
        return float(np.sqrt(np.mean(np.concatenate(self.distances) ** 2)))


def triangulated(camera: CameraModel, plane: LaserPlane, pixels: FloatArray) -> FloatArray:
    """Return the points (M, 3) of stripe pixels (M, 2) in the camera frame, eq. (1): X = −d / (n · r) r."""
    rays = np.column_stack([camera.unproject(pixels), np.ones(len(pixels))])
    points: FloatArray = rays * (-plane.d / (rays @ plane.normal))[:, None]
    return points


def check_table(
    camera: CameraModel, plane: LaserPlane, names: Sequence[str], stripes: Sequence[FloatArray], T_base_cam: FloatArray
) -> TableCheck:
    """Triangulate the stripes (M, 2) of all images, bring them to the base by the poses (N, 4, 4), and fit one plane."""
    points = [transform(T, triangulated(camera, plane, pixels)) for T, pixels in zip(T_base_cam, stripes, strict=True)]
    # Each image counts alike: a longer stripe is no better arm.
    weights = np.concatenate([np.full(len(part), 1 / len(part)) for part in points])
    table = fit_plane_robust(np.concatenate(points), weights)
    return TableCheck(table, tuple(names), tuple(table.distance(part) for part in points))
