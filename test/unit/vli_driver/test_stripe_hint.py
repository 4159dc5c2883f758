"""Hints about the stripe: each is said after a second of trouble, and only then."""

from __future__ import annotations

import numpy as np
import pytest
from stripes import Line, colour_image
from test_scanner import calibration

from vli_common.arrays import ByteArray
from vli_common.types import Image
from vli_driver.scanner import StripeScanner


def plane_image(depth_m: float, peak: float = 180.0) -> ByteArray:
    """Return the short frame (480, 640, 3) of a wall at a depth, parallel to the image."""
    calib = calibration("none", range_m=(0.03, 0.1))
    assert calib.laser is not None
    n, d = calib.laser.normal, calib.laser.d
    x = (np.arange(640) - 323.7) / 362.4
    y = -(d / depth_m + n[0] * x + n[2]) / n[1]
    return colour_image(Line(peak=peak), 363.1 * y + 236.9, 2, height=480)


def hint(pixels: ByteArray, scans: int = 40) -> str:
    scanner = StripeScanner(calibration("none", range_m=(0.03, 0.1)))
    for stamp in range(scans):
        scanner.scan(Image(stamp, pixels))
    return scanner.hint


@pytest.mark.parametrize(
    ("depth_m", "peak", "expected"),
    [
        (0.06, 180.0, ""),
        (0.18, 180.0, "too far: 180 mm, the laser's range ends at 100 mm: move closer"),
        (0.02, 180.0, "too near: 20 mm, the laser's range begins at 30 mm: move away"),
        (0.06, 600.0, "stripe saturated, 100 % of its points: shorten the short exposure, or dim the laser"),
    ],
)
def test_a_second_of_trouble_is_told(depth_m: float, peak: float, expected: str) -> None:
    assert hint(plane_image(depth_m, peak)) == expected


def test_a_moment_of_trouble_is_not_told() -> None:
    assert hint(plane_image(0.18), scans=10) == ""


def test_darkness_is_no_distance() -> None:
    assert hint(np.full((480, 640, 3), 10, np.uint8)) == ""


def test_once_the_stripe_is_back_the_hint_is_gone() -> None:
    scanner = StripeScanner(calibration("none", range_m=(0.03, 0.1)))
    for stamp, depth_m in enumerate([0.18] * 40 + [0.06]):
        scanner.scan(Image(stamp, plane_image(depth_m)))
    assert scanner.hint == ""
