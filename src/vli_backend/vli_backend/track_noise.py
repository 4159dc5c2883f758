"""What a pixel of error is worth on the image plane of rays: not the same all over the image, nor in all directions."""

from __future__ import annotations

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.camera import CameraModel
from vli_common.types import Tracks


def whitening(camera: CameraModel, tracks: Tracks, floor_px: float) -> FloatArray:
    """Return W (N, 2, 2) of the tracks: W (r̂ − r) is the reprojection error of a predicted ray r̂ in sigmas.

    W = J / σ with J = d pixel / d ray at the observation: to first order the error is that in the raw image, where the tracker's
    noise is the same in all directions. On rays it is not: away from the axis of a fisheye it is many times as wide, and
    wider radially than tangentially.

    Args:
        camera: of the calibration.
        tracks: N of them, with a sigma each.
        floor_px: least sigma of a position, added in squares.
    """
    sigma = np.hypot(tracks.sigma_px, floor_px)
    result: FloatArray = camera.jacobian(tracks.rays) / sigma[:, None, None]
    return result
