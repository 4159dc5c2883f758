"""Compile the kernels of this package before the first frame."""

from __future__ import annotations

from functools import cache

import numpy as np

from vli_common.calibration import Calibration, LaserCalibration
from vli_common.camera import make_camera
from vli_common.types import Image
from vli_driver.brightness import brightness
from vli_driver.config import StripeConfig
from vli_driver.scanner import StripeScanner

_SIZE = (96, 128)


@cache
def warm_up() -> None:
    """Scan a synthetic stripe along either axis, in colour and grey; fast where the compiled code is in numba's cache.

    Once in a process, and in what was forked from it.
    """
    camera = make_camera("none", (100.0, 100.0, 64.0, 48.0), (), _SIZE[::-1])
    for axis, normal in ((0, (0.0, 0.8, -0.6)), (1, (0.8, 0.0, -0.6))):
        laser = LaserCalibration(np.array(normal), 0.02, (0.02, 0.15))
        scanner = StripeScanner(Calibration(camera, 60.0, None, 0, None, laser), StripeConfig())
        for pixels in (_stripe(axis), _stripe(axis)[:, :, 2].copy()):
            brightness(pixels)
            scanner.scan(Image(0, pixels))


def _stripe(axis: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """Return (H, W, 3) with a red line across ``axis``, some noise on it so that no branch is skipped."""
    position = np.arange(_SIZE[axis]) - 0.4 * _SIZE[axis]
    profile = 200 * np.exp(-0.5 * (position / 1.5) ** 2)
    grey = np.random.default_rng(0).uniform(0, 6, _SIZE) + (profile[:, None] if axis == 0 else profile[None, :])
    pixels = np.zeros((*_SIZE, 3), np.uint8)
    pixels[:, :, 2] = grey
    pixels[:, :, 0] = pixels[:, :, 1] = 0.1 * grey
    return pixels
