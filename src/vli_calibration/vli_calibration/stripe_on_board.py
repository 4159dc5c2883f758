"""The laser stripe in calibration images: over black and white squares, on a dark surface, narrow or wide.

What is wider than a line (squares, shadows, the glow round an overexposed stripe) is taken off by a top-hat across the stripe;
the detector of the driver finds the line in what is left. That is done for several widths, and the one with the longest straight
line is kept: on a flat surface the stripe is straight once the lens is taken out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from vli_calibration.board_surface import BoardSurface
from vli_calibration.stripe_line import StripeLine, fit_stripe_line
from vli_common.arrays import BoolArray, ByteArray, FloatArray
from vli_common.camera import CameraModel
from vli_driver.config import StripeConfig
from vli_driver.stripe import CentreOfMassDetector, StripePoints
from vli_driver.triangulation import full_band

CHANNELS = ("blue", "green", "red")
_WIDTHS_PX = (6.0, 12.0, 24.0, 48.0, 96.0)
"""Widest lines sought, at half height."""
_OPENING = 2.6
"""Length of the top-hat over the widest line: the foot of a line is some twice as wide as its half height."""
_AVERAGED = 5
"""Profiles averaged along the stripe, pixels."""
_OVEREXPOSED = 230
_SMOOTHING = 12.0
_MOST_SMOOTHING_PX = 5.0
_MAX_LEAN = 0.1
"""Looser than in the driver: a square's edge under the line makes it lean, and the straight line tells what is wrong with it."""
_MIN_LENGTH = 0.12
_ELSEWHERE = 2.0
_SURE_POINTS = 20
_MIN_FILL = 0.4
_MAX_SCATTER = 0.1
_LEAST_SCATTER_PX = 1.5
_MIN_COLOUR_RATIO = 1.4
_LEAST_SIGMA_PX = 0.2
"""What lens model, paper and print leave, as corners show it too."""
_SAMPLE_IMAGES = 6
_SOKAL = 6.0


@dataclass(frozen=True)
class BoardStripe:
    """The stripe of one image.

    Args:
        pixels: (N, 2) raw u, v of all points detected on the surface; far off the line is another surface.
        sigma_px: (N,) across the stripe, one sigma of noise and speckle, and of what lens model, paper and print leave.
        correlation: number of neighbours that err together: integrated autocorrelation of the residuals along the line.
        line: the straight line through them, and which points lie on it.
        on_print: it crosses the print of the board; False: it lies beside the print, on what is taken to be the same sheet.
    """

    pixels: FloatArray
    sigma_px: FloatArray
    correlation: float
    line: StripeLine
    on_print: bool = False

    def __len__(self) -> int:
        return len(self.pixels)

    @cached_property
    def kept(self) -> BoolArray:
        """(N,) points that lie on the line."""
        return self.line.inliers


@dataclass(frozen=True, slots=True)
class Scene:
    """Where to look for a stripe.

    Args:
        pixels: (H, W, 3) BGR or (H, W) grey.
        surface: the board that lies in the same place; None where the whole image shows one flat surface.
    """

    pixels: ByteArray
    surface: BoardSurface | None = None


class StripeFinder:
    """Finds the stripe of one sensor: its lens, direction and colour are the same in all images.

    Args:
        camera: its lens is taken out where straightness counts.
        along_columns: True where there is one point per image column.
        channel: ``blue``, ``green``, ``red`` or ``grey``.
    """

    def __init__(self, camera: CameraModel, along_columns: bool, channel: str) -> None:
        self.camera = camera
        self.along_columns = along_columns
        self.channel = channel
        self._band = full_band(camera.width, camera.height, along_columns)

    @classmethod
    def from_images(cls, camera: CameraModel, scenes: Sequence[Scene]) -> StripeFinder:
        """Return the finder whose direction and colour give the most points in a sample of the images."""
        step = max(1, len(scenes) // _SAMPLE_IMAGES)
        colour = any(scene.pixels.ndim == 3 for scene in scenes)
        finders = [cls(camera, along, channel) for along in (True, False) for channel in (CHANNELS if colour else ("grey",))]
        counts = [0] * len(finders)
        for scene in scenes[::step]:
            for index, finder in enumerate(finders):
                counts[index] += len(finder.find(scene) or ())
        return finders[int(np.argmax(counts))]

    def find(self, scene: Scene) -> BoardStripe | None:
        """Return the stripe, None where there is none."""
        limit = np.inf if scene.surface is None else max(scene.surface.square_px, _OPENING * _WIDTHS_PX[1])
        limit = min(limit, 0.5 * min(self.camera.width, self.camera.height))
        found = [self._find(scene, width) for width in _WIDTHS_PX if _OPENING * width <= limit]
        stripes = [stripe for stripe in found if stripe is not None]
        return max(stripes, key=lambda stripe: (stripe.on_print, int(stripe.kept.sum())), default=None)

    def _find(self, scene: Scene, width_px: float) -> BoardStripe | None:
        points = self._detect(scene.pixels, width_px)
        inside = self._inside(points.pixels, scene.surface, 0.5 * width_px)
        pixels = points.pixels[inside]
        # A table beside the sheet has a stripe too, perhaps the longer one; that on the print is on the board for certain.
        on_print = scene.surface.on_print(pixels) if scene.surface is not None else np.zeros(len(pixels), np.bool_)
        sure = on_print if on_print.sum() >= _SURE_POINTS else None
        line = fit_stripe_line(self.camera, pixels, sure)
        if line is None or not self._is_stripe(pixels, line, width_px):
            return None
        sigma_px = np.hypot(points.sigma_px[inside], _LEAST_SIGMA_PX)
        correlation = correlation_length(line.residuals_px[line.inliers])
        here = np.abs(line.residuals_px) <= _ELSEWHERE * line.tolerance_px
        line = replace(line, residuals_px=line.residuals_px[here], inliers=line.inliers[here])
        return BoardStripe(pixels[here], sigma_px[here], correlation, line, sure is not None)

    def _detect(self, pixels: ByteArray, width_px: float) -> StripePoints:
        config = StripeConfig(
            channel=self.channel if pixels.ndim == 3 else "grey",
            smoothing_px=float(np.clip(width_px / _SMOOTHING, 1.0, _MOST_SMOOTHING_PX)),
            max_width_px=width_px,
            max_lean=_MAX_LEAN,
            min_colour_ratio=_MIN_COLOUR_RATIO,
        )
        light = line_light(pixels, _OPENING * width_px, self.along_columns)
        if pixels.ndim == 3 and self.channel in CHANNELS:
            # The detector takes no colour from overexposed pixels; without their surroundings they no longer look it.
            overexposed = pixels.min(axis=2) >= _OVEREXPOSED
            for channel in set(range(3)) - {CHANNELS.index(self.channel)}:
                light[overexposed, channel] = 255
        return CentreOfMassDetector(config, self._band).detect(light)

    def _inside(self, pixels: FloatArray, surface: BoardSurface | None, margin_px: float) -> BoolArray:
        """Return which points lie on the surface, and not where the image's border cuts the line."""
        axis, size = (1, self.camera.height) if self.along_columns else (0, self.camera.width)
        inside: BoolArray = (pixels[:, axis] >= margin_px) & (pixels[:, axis] <= size - 1 - margin_px)
        if surface is not None:
            inside &= surface.clear(pixels, margin_px, axis)
        return inside

    def _is_stripe(self, pixels: FloatArray, line: StripeLine, width_px: float) -> bool:
        """Return True for a line long, dense and straight enough to be no edge, fringe or reflection."""
        along = pixels[line.inliers, 0 if self.along_columns else 1]
        profiles = self.camera.width if self.along_columns else self.camera.height
        dense = len(along) >= _MIN_FILL * (np.ptp(along) + 1)
        straight = line.scatter_px <= max(_MAX_SCATTER * width_px, _LEAST_SCATTER_PX)
        return bool(len(along) >= _MIN_LENGTH * profiles and dense and straight)


def line_light(pixels: ByteArray, length_px: float, along_columns: bool) -> ByteArray:
    """Return what is narrower than ``length_px`` across the stripe, above its surroundings (white top-hat).

    Neighbouring profiles are averaged: on a flat surface the stripe goes straight on, and speckle averages out.
    """
    length = 2 * int(length_px / 2) + 1
    kernel = np.ones((length, 1) if along_columns else (1, length), np.uint8)
    light = cv2.morphologyEx(pixels, cv2.MORPH_TOPHAT, kernel)
    return np.asarray(cv2.blur(light, (_AVERAGED, 1) if along_columns else (1, _AVERAGED)), np.uint8)


def correlation_length(residuals: FloatArray) -> float:
    """Return the integrated autocorrelation time 1 + 2 Σ ρ_k of residuals (N,) in order along the line, at least 1.

    The sum ends where it exceeds a sixth of the lag's reach (Sokal's window), so that noise does not add up.
    """
    centred = residuals - residuals.mean()
    count = len(centred)
    spectrum = np.abs(np.fft.rfft(centred, 2 * count)) ** 2
    covariance = np.fft.irfft(spectrum)[:count]
    if not covariance[0] > 0:
        return 1.0
    times = 2 * np.cumsum(covariance / covariance[0]) - 1
    closed = np.flatnonzero(np.arange(count) >= _SOKAL * times)
    return float(max(times[closed[0]] if len(closed) else times.max(), 1.0))
