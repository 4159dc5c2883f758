"""The light that the normalisation takes out, and what it leaves."""

from __future__ import annotations

import numpy as np
from planar_scene import texture

from vli_common.types import Image
from vli_frontend.photometry import make_frame, normalise_locally


def test_an_empty_image_is_mid_grey_and_its_noise_is_not_blown_up() -> None:
    noise = np.random.default_rng(0).integers(99, 102, (80, 90)).astype(np.uint8)
    assert np.all(normalise_locally(np.full((80, 90), 200, np.uint8), 11) == 128)
    assert normalise_locally(noise, 11).std() < 25


def test_the_result_does_not_depend_on_gain_and_offset_of_the_light() -> None:
    pattern = texture(size=200)[:120]
    dim = (pattern.astype(np.float64) * 0.6 + 20).astype(np.uint8)
    difference = normalise_locally(pattern, 11).astype(int) - normalise_locally(dim, 11)
    assert np.abs(difference)[11:-11, 11:-11].mean() < 1.5


def test_the_local_mean_and_deviation_are_the_same_everywhere() -> None:
    ramp = np.linspace(0.3, 1.0, 200)
    pattern = (texture(size=200) * ramp).astype(np.uint8)
    out = normalise_locally(pattern, 21).astype(np.float64)
    left, right = out[:, 20:70], out[:, 130:180]
    assert abs(left.mean() - right.mean()) < 3
    assert abs(left.std() / right.std() - 1) < 0.1


def test_the_half_size_image_lies_on_every_second_pixel() -> None:
    y, x = np.mgrid[:100, :120]
    frame = make_frame(Image(0, (x + y).astype(np.uint8)), 21)
    assert frame.half.shape == frame.normalised.shape == (50, 60)
    np.testing.assert_allclose(frame.half[5:-5, 5:-5], (2 * (x + y))[5:45, 5:55], atol=1)


def test_a_colour_image_gives_the_same_as_its_grey_one() -> None:
    pattern = texture(size=100)
    colour, grey = (make_frame(Image(0, p), 21) for p in (np.repeat(pattern[..., None], 3, axis=2), pattern))
    np.testing.assert_array_equal(colour.grey, grey.grey)


def test_a_window_of_one_leaves_the_image_alone() -> None:
    frame = make_frame(Image(0, texture(size=100)), 1)
    assert frame.normalised is frame.half
