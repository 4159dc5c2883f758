"""What a pixel of error is worth on rays, through a lens that bends them."""

from __future__ import annotations

import numpy as np

from vli_backend.track_noise import whitening
from vli_common.arrays import FloatArray
from vli_common.camera import CameraModel, make_camera
from vli_common.types import Tracks

FISHEYE = make_camera("equidistant", (300.0, 310.0, 320.0, 240.0), (-0.021, 0.006, -0.002, 0.0004), (640, 480))


def _tracks(camera: CameraModel, pixels: FloatArray, sigma_px: float) -> Tracks:
    count = len(pixels)
    zeros = np.zeros(count)
    return Tracks(
        0,
        False,
        False,
        np.arange(1, count + 1),
        pixels,
        camera.unproject(pixels),
        np.zeros((count, 2)),
        np.full(count, sigma_px),
        zeros,
        zeros.astype(np.uint8),
    )


def test_pixel_noise_is_unit_noise_in_sigmas_all_over_a_fisheye() -> None:
    rng = np.random.default_rng(0)
    pixels = rng.uniform([20, 20], [620, 460], (4000, 2))
    white = whitening(FISHEYE, _tracks(FISHEYE, pixels, 0.03), 0.04)
    noisy = FISHEYE.unproject(pixels + 0.05 * rng.normal(size=pixels.shape))
    errors = np.einsum("nij,nj->ni", white, noisy - FISHEYE.unproject(pixels))
    outer = np.hypot(*(pixels - [320, 240]).T) > 220
    for part in (outer, ~outer):
        np.testing.assert_allclose(np.cov(errors[part].T), np.eye(2), atol=0.1)


def test_a_fisheye_is_blunter_at_the_edge_and_most_so_radially() -> None:
    centre, edge = whitening(FISHEYE, _tracks(FISHEYE, np.array([[320.0, 240.0], [610.0, 240.0]]), 0.3), 0.0)
    np.testing.assert_allclose(centre, np.diag([300.0, 310.0]) / 0.3, rtol=1e-6)
    assert edge[0, 0] < 0.4 * centre[0, 0]
    assert edge[0, 0] < 0.6 * edge[1, 1]
