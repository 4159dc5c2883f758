"""Compiles every kernel of the package before the first frame."""

from __future__ import annotations

import numpy as np

from vli_common.calibration import Calibration, ImuCalibration
from vli_common.camera import make_camera
from vli_common.types import Image, ImuSample, LaserScan, Mode
from vli_frontend.config import FrontEndConfig
from vli_frontend.frontend import FrontEnd

_PERIOD_NS = 33_333_333


def warm_up() -> None:
    """Run the front end over a few small synthetic frames."""
    camera = make_camera("none", (100.0, 100.0, 80.0, 60.0), (), (160, 120))
    calibration = Calibration(camera, 60.0, np.eye(4), 0, ImuCalibration(200.0, 2e-3, 3e-4, 2e-4, 2e-5), None)
    front_end = FrontEnd(calibration, FrontEndConfig(), Mode.VLI_SLAM)
    texture = np.random.default_rng(0).integers(0, 255, (30, 40, 1)).astype(np.uint8)
    pixels = np.repeat(texture.repeat(4, axis=0).repeat(4, axis=1), 3, axis=2)
    stripe = np.array([[80.0, 60.0]])
    front_end.add_scan(LaserScan(_PERIOD_NS // 2, np.ones((1, 3)), stripe, np.ones(1), np.ones(1)))
    for k in range(1, 4):
        front_end.add_image(Image(k * _PERIOD_NS, np.roll(pixels, k, axis=1)))
        front_end.add_imu(ImuSample(k * _PERIOD_NS, np.zeros(3), np.array([0.0, 0.0, 9.81])))
