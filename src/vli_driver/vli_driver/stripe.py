"""The laser stripe in a short frame, to a fraction of a pixel.

Background off, smoothed peak, centre of mass over a window that fits the line, nothing rounded. Where an edge or a glow makes
the line lean, what is left of it is off: such points are dropped, and what lean remains is in their sigma.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, cast

import cv2
import numpy as np

from vli_common.arrays import AnyArray, BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from vli_common.types import Counters
from vli_driver import stripe_kernels as kernels
from vli_driver import stripe_segments as segments
from vli_driver.config import StripeConfig
from vli_driver.triangulation import SearchBand

_CHANNELS = {"blue": 0, "green": 1, "red": 2}
_PAD = 24
"""Samples beside the band that windows and backgrounds may use."""
_SPECKLE_LIMITS = 0.02, 0.6
_LEAN_BIAS = 3.0
"""Error of a leaning line: an edge that cuts it shifts the centre of mass some three times as far as it makes it lean."""


@dataclass(frozen=True, slots=True)
class StripePoints:
    """Points of the stripe, ordered along it.

    Args:
        pixels: (N, 2) float64, raw u, v.
        intensity: (N,) float64, peak above the background, grey levels.
        sigma_px: (N,) float64, one standard deviation across the stripe.
    """

    pixels: FloatArray
    intensity: FloatArray
    sigma_px: FloatArray

    def __len__(self) -> int:
        return len(self.pixels)


class StripeDetector(Protocol):
    """Finds the stripe in the pixels of a short frame."""

    counters: Counters

    def detect(self, pixels: ByteArray) -> StripePoints:
        """Return the stripe in (H, W, 3) BGR or (H, W) grey; no points where there is none."""
        ...


class CentreOfMassDetector:
    """One point per profile: the centre of mass around the smoothed peak, above the local background.

    Args:
        config: see :class:`StripeConfig`.
        band: where the stripe can be.
    """

    def __init__(self, config: StripeConfig, band: SearchBand) -> None:
        self.config = config
        self.band = band
        self.counters = Counters()
        half = np.exp(-0.5 * (np.arange(int(np.ceil(3 * config.smoothing_px)) + 1) / config.smoothing_px) ** 2)
        self._weights: Float32Array = (half / (2 * half.sum() - half[0])).astype(np.float32)
        self._noise_gain = float(np.sqrt(2 * (self._weights**2).sum() - self._weights[0] ** 2))
        self._smooth: AnyArray = np.empty((0, 0), np.uint16)
        self._start = max(band.start - _PAD, 0)
        self._first: IntArray = np.maximum(band.first - self._start, 0)
        self._last: IntArray = np.maximum(band.last - self._start, 0)

    def detect(self, pixels: ByteArray) -> StripePoints:
        """See :meth:`StripeDetector.detect`."""
        config = self.config
        profiles = self._profiles(pixels)
        channel = self._channel(profiles)
        noise = kernels.noise_level(profiles, channel)
        threshold = max(config.min_peak, config.min_snr * self._noise_gain * noise)
        found = kernels.find_peaks(
            self._smoothed(profiles, channel), self._first, self._last, threshold, config.ambiguity, config.max_width_px
        )
        peaks, ambiguous = segments.choose_chain(found, config.max_jump_px)
        located = kernels.locate(
            profiles, channel, peaks, config.smoothing_px, noise, threshold, config.window_sigmas, config.max_width_px
        )
        ratio = config.min_colour_ratio if profiles.shape[2] > 1 else 0.0
        keep = segments.keep_segments(located, ambiguous, config.max_jump_px, config.min_segment_points, ratio)
        sigma_px = self._sigma_px(located, keep)
        lean_px = segments.steady_lean(located, keep) * located[:, 7]
        # Speckle and noise make the median of nine neighbours lean by less than half a sigma.
        keep &= np.abs(lean_px) <= np.maximum(config.max_lean * located[:, 7], sigma_px)
        segments.trim_segments(located, keep, config.max_jump_px, config.trim_points, config.min_segment_points)
        return self._points(located, np.hypot(sigma_px, _LEAN_BIAS * lean_px), np.flatnonzero(keep))

    def _profiles(self, pixels: ByteArray) -> ByteArray:
        """Return the band as profiles (N, M, C), contiguous."""
        if self.config.channel == "grey" and pixels.ndim == 3:
            pixels = cast(ByteArray, cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY))
        stop = self.band.stop + _PAD
        if self.band.along_columns:
            band = cast(ByteArray, cv2.transpose(pixels[self._start : stop]))
        else:
            band = np.ascontiguousarray(pixels[:, self._start : stop])
        return band if band.ndim == 3 else band[:, :, None]

    def _smoothed(self, profiles: ByteArray, channel: int) -> AnyArray:
        """Return one channel of the profiles (N, M), smoothed along each."""
        lines = profiles[:, :, 0] if profiles.shape[2] == 1 else cv2.extractChannel(profiles, channel)
        # Kept from frame to frame: fresh memory of this size costs more than the convolution.
        if self._smooth.shape != lines.shape:
            self._smooth = np.empty(lines.shape, np.uint16)
        kernels.smooth(lines, self._weights, self._smooth)
        return self._smooth

    def _channel(self, profiles: ByteArray) -> int:
        if profiles.shape[2] == 1:
            return 0
        if self.config.channel == "auto":
            return int(np.argmax(kernels.channel_strength(profiles, self._first, self._last)))
        return _CHANNELS[self.config.channel]

    def _sigma_px(self, located: FloatArray, keep: BoolArray) -> FloatArray:
        """Return (N,) one standard deviation of sensor noise, speckle and lens model."""
        total, sensor, speckled = located[:, 2], located[:, 3], located[:, 4]
        speckle = speckle_contrast(total[keep], speckled[keep]) if keep.sum() > 1 else 0.0
        sigma_px: FloatArray = np.sqrt((sensor + speckle**2 * speckled) / total**2 + self.config.sigma_floor_px**2)
        return sigma_px

    def _points(self, located: FloatArray, sigma_px: FloatArray, rows: IntArray) -> StripePoints:
        if len(rows) < self.config.min_points:
            self.counters.add("no_stripe")
            return StripePoints(np.empty((0, 2)), np.empty(0), np.empty(0))
        across = located[rows, 0] + self._start
        pixels = np.stack([rows, across] if self.band.along_columns else [across, rows], axis=1).astype(np.float64)
        return StripePoints(pixels, located[rows, 1], sigma_px[rows])


def speckle_contrast(total: FloatArray, speckled: FloatArray) -> float:
    """Return the contrast of the speckle of one pixel, from how much the line's total light varies between neighbours.

    For a Gaussian line of width s: var(Σ I) / (Σ I)² = c² / (2 √π s), where Σ k² I² / (Σ I)² = s / (4 √π) tells s.
    """
    steps = np.diff(np.log(np.maximum(total, 1.0)))
    variation = float(np.median(np.abs(steps))) / (0.6745 * np.sqrt(2))
    width = 4 * np.sqrt(np.pi) * float(np.median(speckled / total**2))
    return float(np.clip(variation * np.sqrt(2 * np.sqrt(np.pi) * width), *_SPECKLE_LIMITS))
