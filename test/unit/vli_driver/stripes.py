"""Synthetic stripes: what a camera with noise sees of a laser line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vli_common.arrays import ByteArray, FloatArray

READ_NOISE = 2.0
SHOT_GAIN = 0.1
"""Variance per grey level: ten electrons to a grey level."""


@dataclass(frozen=True)
class Line:
    """A Gaussian line: sigma in px, peak and background in grey levels (beyond 255 it saturates), contrast of the speckle."""

    sigma: float = 2.0
    peak: float = 180.0
    background: float = 10.0
    speckle: float = 0.0


def light(line: Line, centres: FloatArray, height: int, rng: np.random.Generator) -> FloatArray:
    """Return the light (height, N) of a line whose centre in column i is ``centres[i]``, without background and sensor noise."""
    v = np.arange(height)[:, None]
    light: FloatArray = line.peak * np.exp(-0.5 * ((v - centres) / line.sigma) ** 2)
    return light * np.maximum(1 + line.speckle * rng.normal(size=light.shape), 0) if line.speckle else light


def expose(light: FloatArray, rng: np.random.Generator) -> ByteArray:
    """Return what an 8-bit sensor makes of light in grey levels."""
    noisy = (
        light
        + np.sqrt(SHOT_GAIN * np.maximum(light, 0)) * rng.normal(size=light.shape)
        + READ_NOISE * rng.normal(size=light.shape)
    )
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def grey_image(line: Line, centres: FloatArray, height: int = 160, seed: int = 0) -> ByteArray:
    """Return (height, N) with one line that runs across the columns."""
    rng = np.random.default_rng(seed)
    return expose(line.background + light(line, centres, height, rng), rng)


def colour_image(line: Line, centres: FloatArray, channel: int, height: int = 160, seed: int = 0) -> ByteArray:
    """Return (height, N, 3) with a line in one channel, a tenth of it in the others."""
    rng = np.random.default_rng(seed)
    bright = light(line, centres, height, rng)
    return np.stack([expose(line.background + (1.0 if c == channel else 0.1) * bright, rng) for c in range(3)], axis=2)
