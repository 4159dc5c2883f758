"""The stripe detector: accuracy by Monte Carlo, and where it must see nothing."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from stripes import Line, colour_image, expose, grey_image, light

from vli_common.arrays import ByteArray, FloatArray
from vli_driver.config import StripeConfig
from vli_driver.stripe import CentreOfMassDetector, StripePoints
from vli_driver.triangulation import full_band

COLUMNS = 4000
HEIGHT = 160


def detect(pixels: ByteArray, along_columns: bool = True, config: StripeConfig | None = None) -> StripePoints:
    height, width = pixels.shape[:2]
    return CentreOfMassDetector(config or StripeConfig(), full_band(width, height, along_columns)).detect(pixels)


def wavy(count: int = COLUMNS, seed: int = 0) -> FloatArray:
    """Return line centres that take every position between pixels."""
    rng = np.random.default_rng(seed)
    return 80 + 20 * np.sin(np.arange(count) / 130.0) + rng.uniform(-0.05, 0.05, count)


def errors(stripe: StripePoints, centres: FloatArray) -> FloatArray:
    return stripe.pixels[:, 1] - centres[stripe.pixels[:, 0].astype(int)]


# The table of ../shared/notes/stripe.md; its best detectors got 0.036, 0.049, 0.034, 0.137, 0.060, 0.20 px.
@pytest.mark.parametrize(
    ("line", "bound_px"),
    [
        (Line(sigma=1.0), 0.036),
        (Line(sigma=2.0), 0.049),
        (Line(sigma=2.0, peak=800.0), 0.045),
        (Line(sigma=2.0, peak=40.0), 0.145),
        (Line(sigma=2.0, background=60.0), 0.060),
        (Line(sigma=2.5, speckle=0.3), 0.24),
        (Line(sigma=2.5, peak=800.0, speckle=0.2), 0.12),
    ],
    ids=["sigma 1", "sigma 2", "saturated", "dim", "background", "speckle", "saturated speckle"],
)
def test_the_error_of_a_point_is_that_of_the_best_known_detectors(line: Line, bound_px: float) -> None:
    centres = wavy()
    stripe = detect(grey_image(line, centres))
    error = errors(stripe, centres)
    assert len(stripe) > 0.97 * COLUMNS
    assert np.sqrt(np.mean(error**2)) <= bound_px
    # No bias: the mean of 4000 errors is 60 times more accurate than one.
    assert abs(error.mean()) <= 0.06 * bound_px + 0.003


@pytest.mark.parametrize(
    "line", [Line(sigma=1.0), Line(peak=40.0), Line(peak=800.0), Line(sigma=2.5, speckle=0.3), Line(background=60.0)]
)
def test_the_sigma_of_a_point_tells_its_error(line: Line) -> None:
    centres = wavy()
    stripe = detect(grey_image(line, centres))
    ratio = np.median(np.abs(errors(stripe, centres)) / stripe.sigma_px) / 0.6745
    assert 0.5 < ratio < 1.3


def test_no_position_between_pixels_is_preferred() -> None:
    centres = wavy()
    stripe = detect(grey_image(Line(sigma=1.5), centres))
    phase = stripe.pixels[:, 1] % 1
    counts, _ = np.histogram(phase, 10, (0, 1))
    assert counts.min() > 0.8 * counts.mean()


@pytest.mark.parametrize(("channel", "index"), [("auto", 0), ("auto", 1), ("auto", 2), ("red", 2), ("blue", 0), ("grey", 2)])
@pytest.mark.parametrize("along_columns", [True, False])
def test_lasers_of_any_colour_are_found_along_columns_and_rows(channel: str, index: int, along_columns: bool) -> None:
    centres = wavy(640)
    pixels = colour_image(Line(peak=220.0), centres, index)
    if not along_columns:
        pixels = cv2.transpose(pixels)
    stripe = detect(pixels, along_columns, StripeConfig(channel=channel))
    if not along_columns:
        stripe = StripePoints(stripe.pixels[:, ::-1], stripe.intensity, stripe.sigma_px)
    assert len(stripe) > 600
    assert np.sqrt(np.mean(errors(stripe, centres) ** 2)) < (0.06 if channel != "grey" else 0.15)


@pytest.mark.parametrize("along_columns", [True, False])
@pytest.mark.parametrize("level", [0, 5, 60, 200, 255])
@pytest.mark.parametrize("colour", [False, True])
def test_a_frame_without_laser_has_no_stripe(along_columns: bool, level: int, colour: bool) -> None:
    shape = (480, 640, 3) if colour else (480, 640)
    pixels = expose(np.full(shape, float(level)), np.random.default_rng(level))
    assert len(detect(pixels, along_columns)) == 0


def test_edges_and_bright_patches_are_no_stripe() -> None:
    scene = np.full((HEIGHT, 640), 20.0)
    scene[70:110] = 180.0
    scene[120:] = 90.0
    assert len(detect(expose(cv2.GaussianBlur(scene, (0, 0), 1.0), np.random.default_rng(0)))) == 0


def test_a_white_line_is_no_laser() -> None:
    pixels = np.repeat(grey_image(Line(), wavy(640))[:, :, None], 3, axis=2)
    assert len(detect(pixels)) == 0
    assert len(detect(pixels, config=StripeConfig(min_colour_ratio=0.0))) > 600


@pytest.mark.parametrize("share", [0.7, 1.0, 1.3])
def test_of_a_double_line_the_one_that_goes_on_is_taken(share: float) -> None:
    """A reflection, brighter than the stripe or not, beside a third of it."""
    rng = np.random.default_rng(0)
    centres = wavy(640)
    ghost = light(Line(peak=120 * share), centres - 30, HEIGHT, rng)
    ghost[:, :200] = ghost[:, 400:] = 0
    stripe = detect(expose(10 + light(Line(peak=120), centres, HEIGHT, rng) + ghost, rng))
    assert len(stripe) > 430
    assert np.abs(errors(stripe, centres)).max() < 1


def test_a_double_line_that_nothing_decides_is_dropped() -> None:
    rng = np.random.default_rng(0)
    centres = wavy(640)
    both = light(Line(), centres, HEIGHT, rng) + light(Line(), centres - 30, HEIGHT, rng)
    assert len(detect(expose(10 + both, rng))) == 0


def test_where_the_line_leans_it_is_dropped() -> None:
    """A glow on one side, as of a wall beside the line, in a third of the columns: what it hits is off."""
    rng = np.random.default_rng(0)
    centres = np.full(640, 80.3)
    glow = np.clip((np.arange(HEIGHT)[:, None] - centres) / 8, 0, 1) * (np.arange(HEIGHT)[:, None] < centres + 8) * 90.0
    glow[:, :200] = glow[:, 400:] = 0
    stripe = detect(expose(10 + light(Line(), centres, HEIGHT, rng) + glow, rng))
    inside = (stripe.pixels[:, 0] > 205) & (stripe.pixels[:, 0] < 395)
    assert inside.sum() < 20
    assert (~inside).sum() > 420
    assert np.abs(errors(stripe, centres)).max() < 0.5


def test_steps_split_the_line_and_short_pieces_are_dropped() -> None:
    centres = np.full(640, 60.0)
    centres[300:310] = 90.0
    centres[310:] = 70.0
    stripe = detect(grey_image(Line(), centres))
    assert not np.any((stripe.pixels[:, 0] >= 300) & (stripe.pixels[:, 0] < 310))
    assert len(stripe) > 600
    assert np.abs(errors(stripe, centres)).max() < 0.5


def test_a_frame_with_few_points_counts_as_empty() -> None:
    image = np.full((HEIGHT, 640), 5, np.uint8)
    image[:, 100:118] = grey_image(Line(), np.full(18, 80.0))
    detector = CentreOfMassDetector(StripeConfig(), full_band(640, HEIGHT, True))
    assert len(detector.detect(image)) == 0
    assert detector.counters["no_stripe"] == 1


def test_a_line_at_the_border_does_no_harm() -> None:
    for row in (0.0, 1.5, HEIGHT - 2.0):
        stripe = detect(grey_image(Line(), np.full(640, row)))
        assert np.all(np.isfinite(stripe.pixels))


def real_images(folder: Path) -> list[ByteArray]:
    return [cv2.imread(str(path)) for path in sorted(folder.glob("*.png"), key=lambda path: (len(path.name), path.name))]


@pytest.mark.parametrize("along_columns", [True, False])
@pytest.mark.parametrize("channel", ["auto", "red", "grey"])
def test_real_images_without_laser_have_no_stripe(shared_data: Path, channel: str, along_columns: bool) -> None:
    counts = [
        len(detect(pixels, along_columns, StripeConfig(channel=channel)))
        for pixels in real_images(shared_data / "blaser_calibration/640_v1_laser_off")
    ]
    assert counts == [0] * 9


def test_real_stripes_are_found_even_under_a_lit_board(shared_data: Path) -> None:
    counts = [len(detect(pixels)) for pixels in real_images(shared_data / "blaser_calibration/640_unified")]
    assert sum(count >= 40 for count in counts[:13]) >= 11  # board lit, long exposure
    assert sum(count >= 40 for count in counts[13:]) >= 8  # of twelve, three blurred to 30 px


def test_real_images_of_the_wide_sensor_have_a_stripe_where_the_laser_is_on(shared_data: Path) -> None:
    counts = [len(detect(pixels)) for pixels in real_images(shared_data / "blaser_calibration/handheld_1280x720")]
    assert sum(count > 0 for count in counts[:17]) >= 15
    assert counts[17:] == [0] * 19


def test_an_overexposed_line_is_white_in_its_core_and_keeps_the_colour_of_its_flanks() -> None:
    centres = np.full(400, 80.0)
    pixels = colour_image(Line(sigma=4.0, peak=240.0), centres, 2)
    pixels[np.repeat(pixels[:, :, 2:] >= 200, 3, axis=2)] = 255
    assert len(detect(pixels, config=StripeConfig(channel="red", max_width_px=24.0, max_lean=0.1))) > 380


def test_a_white_line_that_is_not_overexposed_is_still_no_laser() -> None:
    grey = grey_image(Line(sigma=2.0, peak=120.0), np.full(400, 80.0))
    assert len(detect(np.repeat(grey[:, :, None], 3, axis=2))) == 0
