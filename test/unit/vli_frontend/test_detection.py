"""Where new points are taken."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from planar_scene import texture
from scipy.spatial.distance import pdist

from vli_common.arrays import ByteArray
from vli_frontend.config import DetectionConfig
from vli_frontend.detection import detect
from vli_frontend.patch_alignment import MARGIN_PX

CONFIG = DetectionConfig()
NONE = np.empty((0, 2))


@pytest.fixture(scope="module")
def half() -> ByteArray:
    return cv2.pyrDown(texture(size=480))


def test_points_keep_their_distance_and_stay_off_the_border(half: ByteArray) -> None:
    found = detect(half, NONE, 100, CONFIG)
    assert len(found) == 100
    assert pdist(found).min() >= CONFIG.distance_px
    assert found.min() >= MARGIN_PX
    assert found.max() <= 479 - MARGIN_PX


def test_new_points_keep_their_distance_from_those_that_are_there(half: ByteArray) -> None:
    existing = detect(half, NONE, 60, CONFIG)
    found = detect(half, existing, 40, CONFIG)
    assert len(found) == 40
    assert pdist(np.concatenate([existing, found])).min() >= CONFIG.distance_px


def test_a_strong_texture_in_one_half_does_not_take_all_points() -> None:
    pattern = texture(size=480).astype(np.float64) - 128
    pattern[:, :240] *= 0.3
    found = detect(cv2.pyrDown((pattern + 128).astype(np.uint8)), NONE, 80, CONFIG)
    assert 30 <= (found[:, 0] < 240).sum() <= 50


def test_points_lie_on_corners() -> None:
    board = np.kron(np.indices((6, 6)).sum(axis=0) % 2, np.ones((40, 40))).astype(np.uint8) * 150 + 50
    found = detect(cv2.pyrDown(board), NONE, 25, CONFIG)
    assert len(found) == 25
    np.testing.assert_allclose((found + 0.5) / 40, np.round((found + 0.5) / 40), atol=0.08)


def test_an_empty_noisy_image_has_no_points() -> None:
    noise = 100 + 2 * np.random.default_rng(0).standard_normal((480, 640))
    assert len(detect(cv2.pyrDown(cv2.GaussianBlur(noise.astype(np.uint8), (3, 3), 0)), NONE, 100, CONFIG)) == 0


@pytest.mark.parametrize("count", [0, -3])
def test_nothing_is_taken_where_nothing_is_wanted(half: ByteArray, count: int) -> None:
    assert detect(half, NONE, count, CONFIG).shape == (0, 2)
