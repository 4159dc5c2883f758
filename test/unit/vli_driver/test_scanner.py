"""Eq. (1), its sigma, the search band, and a whole short frame."""

from __future__ import annotations

import numpy as np
import pytest
from stripes import Line, colour_image

from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration, LaserCalibration
from vli_common.camera import make_camera
from vli_common.errors import CalibrationError, InputError
from vli_common.types import Image
from vli_driver.config import StripeConfig
from vli_driver.scanner import StripeScanner
from vli_driver.triangulation import Triangulator, search_band, stripe_runs_across_columns

LENSES = {
    "none": ("none", ()),
    "radtan": ("radtan", (-0.118, 0.017, 0.0007, -0.0005)),
    "radtan k3": ("radtan", (-0.3, 0.1, 0.001, -0.001, -0.02)),
    "equidistant": ("equidistant", (0.01, -0.02, 0.005, -0.001)),
}


def calibration(lens: str = "radtan", horizontal: bool = True, range_m: tuple[float, float] = (0.02, 0.15)) -> Calibration:
    model, coefficients = LENSES[lens]
    camera = make_camera(model, (362.4, 363.1, 323.7, 236.9), coefficients, (640, 480))
    normal = np.array([0.026, -0.941, -0.336]) if horizontal else np.array([-0.941, 0.026, -0.336])
    return Calibration(camera, 60.0, None, 0, None, LaserCalibration(normal / np.linalg.norm(normal), 0.01177, range_m))


def plane_points(calib: Calibration, depth: FloatArray, lateral: FloatArray) -> FloatArray:
    """Return points (N, 3) of the laser plane at given depths and places along the stripe."""
    assert calib.laser is not None
    n, d = calib.laser.normal, calib.laser.d
    if stripe_runs_across_columns(calib.laser):
        return np.stack([lateral, -(d + n[0] * lateral + n[2] * depth) / n[1], depth], axis=1)
    return np.stack([-(d + n[1] * lateral + n[2] * depth) / n[0], lateral, depth], axis=1)


def visible_points(calib: Calibration, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """Return points of the plane within range and the image, and their pixels."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.022, 0.14, 2000)
    points = plane_points(calib, depth, depth * rng.uniform(-0.7, 0.7, 2000))
    pixels = calib.camera.project(points)
    inside = np.all((pixels >= 0) & (pixels <= [639, 479]), axis=1)
    return points[inside], pixels[inside]


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("horizontal", [True, False])
def test_points_of_the_plane_come_back_from_their_pixels(lens: str, horizontal: bool) -> None:
    calib = calibration(lens, horizontal)
    expected, pixels = visible_points(calib)
    points, sigma, valid = Triangulator(calib, horizontal, 0.1).triangulate(pixels, np.full(len(pixels), 0.1))
    assert len(points) > 500
    assert valid.all()
    # Far below the sigma of a tenth of a pixel: the table of rays costs nothing.
    assert np.all(np.linalg.norm(points - expected, axis=1) < 0.02 * sigma + 1e-8)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("horizontal", [True, False])
def test_sigma_is_how_far_a_point_moves_along_its_ray(lens: str, horizontal: bool) -> None:
    calib = calibration(lens, horizontal)
    _, pixels = visible_points(calib)
    pixels = np.clip(pixels, 1, [638, 478])
    triangulator = Triangulator(calib, horizontal, 0.5)
    step = np.array([0, 0.01] if horizontal else [0.01, 0])
    near, far = (np.linalg.norm(triangulator.triangulate(pixels + s * step, np.ones(len(pixels)))[0], axis=1) for s in (-1, 1))
    _, sigma, _ = triangulator.triangulate(pixels, np.full(len(pixels), 0.02))
    np.testing.assert_allclose(sigma, np.abs(far - near), rtol=0.02)


def test_sigma_grows_with_the_square_of_the_depth() -> None:
    calib = calibration("none")
    depth = np.array([0.03, 0.06])
    pixels = calib.camera.project(plane_points(calib, depth, np.zeros(2)))
    _, sigma, _ = Triangulator(calib, True, 0.1).triangulate(pixels, np.full(2, 0.1))
    assert sigma[1] / sigma[0] == pytest.approx(4, rel=0.1)


def test_points_beyond_the_range_are_not_valid() -> None:
    calib = calibration(range_m=(0.03, 0.1))
    depth = np.array([0.02, 0.026, 0.031, 0.099, 0.115])
    pixels = calib.camera.project(plane_points(calib, depth, np.zeros(5)))
    _, _, valid = Triangulator(calib, True, 0.1).triangulate(pixels, np.ones(5))
    assert valid.tolist() == [False, False, True, True, False]


@pytest.mark.parametrize("horizontal", [True, False])
def test_the_band_holds_the_plane_within_its_range_and_not_much_else(horizontal: bool) -> None:
    calib = calibration(horizontal=horizontal)
    band = search_band(calib, horizontal, 0.1)
    _, pixels = visible_points(calib)
    profile, sample = (pixels if horizontal else pixels[:, ::-1]).T
    index = np.round(profile).astype(int)
    assert np.all((sample >= band.first[index] - 1) & (sample <= band.last[index] + 1))
    assert (band.last - band.first).mean() < 0.6 * (480 if horizontal else 640)


def test_the_orientation_follows_the_plane() -> None:
    for horizontal in (True, False):
        laser = calibration(horizontal=horizontal).laser
        assert laser is not None
        assert stripe_runs_across_columns(laser) is horizontal


@pytest.mark.parametrize("horizontal", [True, False])
@pytest.mark.parametrize("grey", [False, True])
def test_a_short_frame_becomes_points_on_the_surface(horizontal: bool, grey: bool) -> None:
    """A plane at 40 mm, tilted: the scan lies on it to within what its sigmas say."""
    calib = calibration(horizontal=horizontal)
    lateral = np.linspace(-0.05, 0.05, 20000)
    along = calib.camera.project(plane_points(calib, 0.04 + 0.2 * lateral, lateral))
    count, height = (640, 480) if horizontal else (480, 640)
    profile, sample = (along if horizontal else along[:, ::-1]).T
    image = colour_image(Line(sigma=1.8, peak=200), np.interp(np.arange(count), profile, sample), 2, height)
    image = image if horizontal else np.ascontiguousarray(image.transpose(1, 0, 2))
    scan = StripeScanner(calib).scan(Image(7, np.ascontiguousarray(image[:, :, 2]) if grey else image, session=3))
    assert len(scan) > 0.9 * count
    assert (scan.stamp_ns, scan.session) == (7, 3)
    along_stripe = scan.points[:, 0 if horizontal else 1]
    error = scan.points[:, 2] - (0.04 + 0.2 * along_stripe)
    assert np.sqrt(np.mean(error**2)) < 0.03e-3
    assert np.median(np.abs(error) / scan.sigma) / 0.6745 < 1.5
    assert np.all(np.diff(scan.pixels[:, 0 if horizontal else 1]) > 0)


def test_a_dark_frame_gives_an_empty_scan() -> None:
    scanner = StripeScanner(calibration())
    scan = scanner.scan(Image(7, np.zeros((480, 640), np.uint8)))
    assert (len(scan), scan.points.shape, scan.stamp_ns) == (0, (0, 3), 7)
    assert scanner.counters["empty"] == 1


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(InputError, match="image is '320 x 240', the calibration is for 640 x 480"):
        StripeScanner(calibration()).scan(Image(0, np.zeros((240, 320), np.uint8)))


def test_a_laser_that_cannot_be_seen_within_its_range_is_refused() -> None:
    with pytest.raises(CalibrationError, match="laser plane is nowhere in the image at 'range_m'"):
        StripeScanner(calibration(range_m=(0.0005, 0.001)))


def test_a_calibration_without_laser_is_refused() -> None:
    calib = calibration()
    with pytest.raises(CalibrationError, match=r"laser0.*section is missing"):
        StripeScanner(Calibration(calib.camera, 60.0, None, 0, None, None), StripeConfig())
