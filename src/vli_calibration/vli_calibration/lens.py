"""Projection with derivatives for the fits, of each lens model that a calibration file can hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from vli_common.arrays import AnyArray, FloatArray
from vli_common.camera import CameraModel, make_camera

PARAMETERS = ("fx", "fy", "cx", "cy")
"""Names of the first entries of a parameter vector; the distortion's follow."""


@dataclass(frozen=True, slots=True)
class Lens:
    """A lens model: its name here and in the calibration file, and its distortion coefficients in the file's order.

    Args:
        name: radtan4, radtan5 or equidistant.
        model: distortion_model of the calibration file.
        coefficients: names.
    """

    name: str
    model: str
    coefficients: tuple[str, ...]
    _project: Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray, FloatArray]]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the entries of a parameter vector."""
        return PARAMETERS + self.coefficients

    def project(self, points: FloatArray, pose: FloatArray, parameters: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return pixels (N, 2) and their derivatives by pose (2N, 6) and parameters (2N, P), rows u0 v0 u1 and so on.

        Args:
            points: (N, 3) in the board frame.
            pose: (6,) rotation vector and translation of T_cam_board.
            parameters: (P,) fx fy cx cy and distortion.
        """
        return self._project(points, pose, parameters)

    def camera(self, parameters: FloatArray, resolution: tuple[int, int]) -> CameraModel:
        """Return the camera of a parameter vector."""
        values = tuple(float(value) for value in parameters)
        return make_camera(self.model, values[:4], values[4:], resolution)


def _matrix(parameters: FloatArray) -> FloatArray:
    fx, fy, cx, cy = parameters[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def _float(values: AnyArray) -> FloatArray:
    return np.asarray(values, dtype=np.float64)


def _radtan(points: FloatArray, pose: FloatArray, parameters: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    pixels, jacobian = cv2.projectPoints(points, pose[:3], pose[3:], _matrix(parameters), parameters[4:])
    return _float(pixels).reshape(-1, 2), _float(jacobian[:, :6]), _float(jacobian[:, 6 : 6 + len(parameters)])


def _equidistant(points: FloatArray, pose: FloatArray, parameters: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    pixels, jacobian = cv2.fisheye.projectPoints(points[:, None], pose[:3], pose[3:], _matrix(parameters), parameters[4:])
    return _float(pixels).reshape(-1, 2), _float(jacobian[:, 8:14]), _float(jacobian[:, :8])


LENSES: dict[str, Lens] = {
    "radtan4": Lens("radtan4", "radtan", ("k1", "k2", "p1", "p2"), _radtan),
    "radtan5": Lens("radtan5", "radtan", ("k1", "k2", "p1", "p2", "k3"), _radtan),
    "equidistant": Lens("equidistant", "equidistant", ("k1", "k2", "k3", "k4"), _equidistant),
}
"""Lens models, fewest parameters first."""


def lens_of(camera: CameraModel) -> tuple[Lens, FloatArray]:
    """Return the lens model of a camera, and its parameter vector."""
    name = "equidistant" if type(camera).__name__.startswith("Equidistant") else f"radtan{len(camera.coefficients)}"
    return LENSES[name], np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.coefficients])
