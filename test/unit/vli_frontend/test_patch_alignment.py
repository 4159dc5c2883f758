"""Alignment of patches under known warps and light."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from planar_scene import texture
from scipy.ndimage import map_coordinates

from vli_common.arrays import ByteArray, FloatArray
from vli_frontend.patch_alignment import Aligned, PatchTemplates

POINTS = np.array([[60.0, 70.3], [120.25, 60.75], [100.5, 130.0], [150.8, 149.1]])
SLOTS = np.array([3, 0, 5, 1])
IDENTITY = np.tile(np.eye(2), (4, 1, 1))


def warped(pattern: ByteArray, affine: FloatArray, shift: FloatArray, light: FloatArray | float = 1.0) -> ByteArray:
    """Return the image in which the content at x appears at ``affine`` x + ``shift``."""
    height, width = pattern.shape
    back = np.linalg.inv(affine)
    y, x = np.mgrid[:height, :width].astype(np.float64)
    source = np.stack([x - shift[0], y - shift[1]], axis=-1) @ back.T
    # A spline: OpenCV's cubic kernel shifts the picture by up to 0.05 px.
    values = map_coordinates(pattern.astype(np.float64), [source[..., 1], source[..., 0]], order=5, mode="nearest")
    return np.clip(np.round(values * light), 0, 255).astype(np.uint8)


def align(first: ByteArray, second: ByteArray, start: FloatArray) -> Aligned:
    templates = PatchTemplates(6)
    templates.create(first, SLOTS, POINTS)
    assert templates.valid[SLOTS].all()
    return templates.align(second, SLOTS, start, IDENTITY)


@pytest.fixture(scope="module")
def pattern() -> ByteArray:
    return cv2.GaussianBlur(texture(size=220), (3, 3), 0)


def test_a_shift_is_found_to_a_few_hundredths_of_a_pixel(pattern: ByteArray) -> None:
    shift = np.array([1.37, -0.82])
    found = align(pattern, warped(pattern, np.eye(2), shift), POINTS + np.round(shift))
    assert found.converged.all()
    np.testing.assert_allclose(found.pixels, POINTS + shift, atol=0.03)
    assert found.correlation.min() > 0.99


def test_an_affine_warp_is_found_with_its_position(pattern: ByteArray) -> None:
    affine, shift = np.array([[1.06, 0.05], [-0.04, 0.97]]), np.array([-7.3, 6.1])
    truth = POINTS @ affine.T + shift
    found = align(pattern, warped(pattern, affine, shift), truth + np.array([0.6, -0.5]))
    assert found.converged.all()
    np.testing.assert_allclose(found.pixels, truth, atol=0.03)
    np.testing.assert_allclose(found.affine, np.tile(affine, (4, 1, 1)), atol=0.01)


def test_a_gain_that_slopes_across_the_patch_does_not_pull_the_position(pattern: ByteArray) -> None:
    slope = np.linspace(1.3, 0.5, pattern.shape[1])[None]
    found = align(pattern, warped(pattern, np.eye(2), np.zeros(2), slope), POINTS + np.array([0.4, 0.3]))
    assert found.converged.all()
    np.testing.assert_allclose(found.pixels, POINTS, atol=0.03)


def test_another_patch_is_told_by_its_correlation(pattern: ByteArray) -> None:
    found = align(pattern, cv2.GaussianBlur(texture(seed=9, size=220), (3, 3), 0), POINTS)
    assert not (found.converged & (found.correlation > 0.8)).any()


def test_where_nothing_is_found_the_start_stays(pattern: ByteArray) -> None:
    found = align(pattern, np.full_like(pattern, 90), POINTS + 0.25)
    assert not found.converged.any()
    np.testing.assert_array_equal(found.pixels, POINTS + 0.25)


def test_a_patch_without_texture_is_no_template() -> None:
    templates = PatchTemplates(2)
    ramp = np.tile(np.arange(0, 220, dtype=np.uint8), (220, 1))
    templates.create(np.full((220, 220), 77, np.uint8), np.array([0]), POINTS[:1])
    templates.create(ramp, np.array([1]), POINTS[:1])
    assert not templates.valid.any()
    assert np.isinf(templates.sigma_per_level).all()
    found = templates.align(ramp, np.array([0, 1]), POINTS[:2], IDENTITY[:2])
    assert not found.converged.any()


def test_the_bound_on_the_position_predicts_its_scatter_under_noise(pattern: ByteArray) -> None:
    templates = PatchTemplates(6)
    templates.create(pattern, SLOTS, POINTS)
    rng = np.random.default_rng(1)
    noise, errors = 3.0, []
    for _ in range(60):
        noisy = np.clip(pattern + noise * rng.standard_normal(pattern.shape), 0, 255).round().astype(np.uint8)
        errors.append(templates.align(noisy, SLOTS, POINTS, IDENTITY).pixels - POINTS)
    measured = np.sqrt((np.array(errors) ** 2).mean(axis=(0, 2)))
    # Bilinear sampling averages the noise: the bound of white noise is an upper one here.
    predicted = noise * templates.sigma_per_level[SLOTS]
    assert np.all(measured < 1.1 * predicted)
    assert np.all(measured > 0.4 * predicted)


def test_sigma_follows_the_noise_and_is_infinite_where_nothing_is_found(pattern: ByteArray) -> None:
    templates = PatchTemplates(6)
    templates.create(pattern, SLOTS, POINTS)
    rng = np.random.default_rng(2)
    noisy = [np.clip(pattern + noise * rng.standard_normal(pattern.shape), 0, 255).astype(np.uint8) for noise in (1.0, 4.0)]
    little, much = (templates.align(image, SLOTS, POINTS, IDENTITY).sigma for image in noisy)
    assert np.all(much > 2 * little)
    assert np.isinf(templates.align(np.full_like(pattern, 90), SLOTS, POINTS, IDENTITY).sigma).all()


def test_sigma_tells_a_patch_across_a_depth_edge(pattern: ByteArray) -> None:
    """The right half of each patch moves by half a pixel more than the left one."""
    near, far = (warped(pattern, np.eye(2), np.array([shift, 0.0])) for shift in (0.5, 0.0))
    split = far.copy()
    for x, y in POINTS.round().astype(int):
        split[y - 20 : y + 21, x : x + 20] = near[y - 20 : y + 21, x : x + 20]
    whole, torn = align(pattern, far, POINTS), align(pattern, split, POINTS)
    assert np.all(torn.sigma > 2 * whole.sigma)


_ALIGN_AND_PRINT = """
import numpy as np
from planar_scene import texture
from vli_frontend.patch_alignment import PatchTemplates
image, slots = texture(0), np.arange(20)
pixels = np.random.default_rng(0).uniform(30.0, 90.0, (20, 2))
templates = PatchTemplates(20)
templates.create(image, slots, pixels)
found = templates.align(image, slots, pixels + 0.7, np.tile(np.eye(2), (20, 1, 1)))
print(found.converged.sum(), np.concatenate([found.pixels.ravel(), found.correlation]).tobytes().hex())
"""


@pytest.mark.slow
def test_kernels_that_were_just_compiled_round_as_those_of_the_cache_do(tmp_path: Path) -> None:
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": path}
    command = [sys.executable, "-c", _ALIGN_AND_PRINT]
    first, second = (
        subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout for _ in range(2)
    )
    assert int(first.split()[0]) > 10
    assert first == second
