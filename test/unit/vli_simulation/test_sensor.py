"""The sensor's mosaic, noise and encodings."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vli_simulation.config import SensorConfig
from vli_simulation.sensor import Sensor


def _mosaic(level: float, seed: int = 0, **config: float) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    sensor = Sensor(SensorConfig(**config), 200, 300, 0)
    return sensor.expose(np.full((200, 300), level, np.float32), np.random.default_rng(seed))


def test_noise_is_shot_noise_and_read_noise() -> None:
    gain = 255 / 9000.0
    for level in (20.0, 100.0, 180.0):
        pair = _mosaic(level, 1).astype(np.float64) - _mosaic(level, 2)
        # The difference of two exposures is free of the pixels' own responses; 1/12 is the rounding to grey levels.
        expected = level * gain + (22.0 * gain) ** 2 + 1 / 12
        assert pair.var() / 2 == pytest.approx(expected, rel=0.05)


def test_it_saturates_at_255_and_is_never_negative() -> None:
    assert _mosaic(2000.0).min() == 255
    dark = _mosaic(0.0, black_level=0.0)
    assert dark.min() == 0
    assert dark.mean() < 0.5


@pytest.mark.parametrize("encoding", ["bayer", "bayer-png", "rgb", "jpeg", "mono"])
def test_each_encoding_decodes_to_the_same_picture(encoding: str) -> None:
    red = np.zeros((200, 300), np.float32)
    red[::2, ::2] = 200
    sensor = Sensor(SensorConfig(encoding=encoding), 200, 300, 0)
    frame = sensor.encode(sensor.expose(red, np.random.default_rng(0)))
    data = np.frombuffer(frame.data, np.uint8)
    if encoding in ("bayer", "bayer-png"):
        mosaic = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if frame.compressed else data.reshape(200, frame.step)
        assert "bayer_rggb8" in frame.encoding
        assert mosaic[::2, ::2].mean() == pytest.approx(201, abs=1)
        assert mosaic[1::2].mean() < 3
    elif encoding == "mono":
        assert data.reshape(200, 300).mean() == pytest.approx(0.299 * 201, abs=2)
    else:
        colour = cv2.imdecode(data, cv2.IMREAD_COLOR) if frame.compressed else data.reshape(200, 300, 3)[..., ::-1]
        np.testing.assert_allclose(colour.mean(axis=(0, 1)), [1, 1, 201], atol=4)


def test_the_same_seed_gives_the_same_noise() -> None:
    np.testing.assert_array_equal(_mosaic(90.0, 7), _mosaic(90.0, 7))
    assert np.any(_mosaic(90.0, 7) != _mosaic(90.0, 8))
