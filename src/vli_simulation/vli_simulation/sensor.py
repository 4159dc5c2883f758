"""The image sensor: Bayer mosaic, shot and read noise, saturation; and the encodings a driver would publish."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
import simplejpeg

from vli_common.arrays import ByteArray, Float32Array, FloatArray
from vli_simulation.config import SensorConfig

_PIXEL_RESPONSE_SIGMA = 0.004


@dataclass(frozen=True)
class EncodedFrame:
    """An image as bytes; ``encoding`` as in ``sensor_msgs/Image`` or, where ``compressed``, the format of a CompressedImage."""

    data: bytes
    encoding: str
    compressed: bool
    step: int = 0


class Sensor:
    """Turns light into grey levels: 255 is a full well."""

    def __init__(self, config: SensorConfig, height: int, width: int, seed: int) -> None:
        self._config = config
        rng = np.random.default_rng([seed, 5])
        self._response = (1 + _PIXEL_RESPONSE_SIGMA * rng.standard_normal((height, width))).astype(np.float32)

    def expose(self, light: Float32Array, rng: np.random.Generator) -> ByteArray:
        """Return the RGGB mosaic (H, W) of the light on each of its pixels (H, W), in grey levels before noise and saturation."""
        config = self._config
        mosaic = np.empty(light.shape, np.uint8)
        noise = rng.standard_normal(light.shape, dtype=np.float32)
        _read_out(light, self._response, noise, 255.0 / config.full_well_e, config.read_noise_e, config.black_level, mosaic)
        return mosaic

    def ideal(self, light: FloatArray) -> ByteArray:
        """Return colours (N, 3) of ``light`` (N, 3) without noise, same order of channels."""
        return np.clip(np.round(light + self._config.black_level), 0, 255).astype(np.uint8)

    @staticmethod
    def develop(mosaic: ByteArray) -> ByteArray:
        """Return the colours (H, W, 3), blue green red, of a mosaic (H, W)."""
        # OpenCV names a mosaic by its second row and column: its BG is everyone's RGGB.
        colour: ByteArray = cv2.cvtColor(mosaic, cv2.COLOR_BayerBG2BGR).astype(np.uint8, copy=False)
        return colour

    def encode(self, mosaic: ByteArray) -> EncodedFrame:
        """Return a mosaic in the encoding of the config."""
        encoding, width = self._config.encoding, mosaic.shape[1]
        if encoding == "bayer":
            return EncodedFrame(mosaic.tobytes(), "bayer_rggb8", False, width)
        if encoding == "bayer-png":
            return EncodedFrame(cv2.imencode(".png", mosaic)[1].tobytes(), "bayer_rggb8; png compressed", True)
        colour = self.develop(mosaic)
        if encoding == "mono":
            return EncodedFrame(cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY).tobytes(), "mono8", False, width)
        if encoding == "rgb":
            return EncodedFrame(cv2.cvtColor(colour, cv2.COLOR_BGR2RGB).tobytes(), "rgb8", False, 3 * width)
        data = simplejpeg.encode_jpeg(
            np.ascontiguousarray(colour), quality=self._config.quality, colorspace="BGR", colorsubsampling="420"
        )
        return EncodedFrame(data, "bgr8; jpeg compressed bgr8", True)


@numba.njit(cache=True, nogil=True)
def _read_out(
    light: Float32Array,
    response: Float32Array,
    noise: Float32Array,
    gain: float,
    read_noise: float,
    black: float,
    mosaic: ByteArray,
) -> None:
    """Fill ``mosaic`` (H, W) with noise in electrons, full well, black level, rounding; ``gain`` is grey levels an electron."""
    height, width = mosaic.shape
    for i in range(height):
        for j in range(width):
            charge = min(light[i, j] * response[i, j] / gain, 4.0 * 255.0 / gain)
            charge += noise[i, j] * np.sqrt(charge + read_noise * read_noise)
            mosaic[i, j] = np.uint8(min(max(np.round(min(charge * gain, 255.0) + black), 0.0), 255.0))
