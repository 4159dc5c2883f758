"""Lucas–Kanade on shifted pictures."""

from __future__ import annotations

import numpy as np
import pytest
from planar_scene import texture

from vli_common.arrays import FloatArray
from vli_common.types import Image
from vli_frontend.config import KltConfig
from vli_frontend.klt import follow
from vli_frontend.photometry import Frame, make_frame

TEXTURE = texture(size=400)
POINTS = np.array([[80.0, 90.0], [150.0, 100.0], [120.0, 170.0], [200.0, 75.0]])


def view(dx: int, dy: int) -> Frame:
    """Return the window of the texture in which everything appears moved by (dx, dy)."""
    return make_frame(Image(0, np.ascontiguousarray(TEXTURE[80 - dy : 320 - dy, 60 - dx : 340 - dx])), 21)


@pytest.mark.parametrize("flow", [(1, 0), (-3, 5), (12, 9)])
def test_points_follow_the_picture_from_no_prediction(flow: tuple[int, int]) -> None:
    found, ok = follow(view(0, 0), view(*flow), POINTS, POINTS, KltConfig())
    assert ok.all()
    np.testing.assert_allclose(found, POINTS + flow, atol=0.15)


def test_a_prediction_reaches_farther_than_the_pyramid() -> None:
    flow = np.array([45.0, -38.0])
    found, ok = follow(view(0, 0), view(45, -38), POINTS, POINTS + flow + 2.0, KltConfig())
    assert ok.all()
    np.testing.assert_allclose(found, POINTS + flow, atol=0.15)


def test_a_point_whose_surroundings_changed_is_lost() -> None:
    other = make_frame(Image(0, texture(seed=5, size=400)[80:320, 60:340].copy()), 21)
    _, ok = follow(view(0, 0), other, POINTS, POINTS, KltConfig())
    assert not ok.any()


def test_no_points_are_no_problem() -> None:
    none: FloatArray = np.empty((0, 2))
    found, ok = follow(view(0, 0), view(1, 1), none, none, KltConfig())
    assert found.shape == (0, 2)
    assert ok.shape == (0,)
