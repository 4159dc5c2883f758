"""Pyramidal Lucas–Kanade with a forward–backward check (Bouguet, 2001; Kalal et al., 2010)."""

from __future__ import annotations

import cv2
import numpy as np

from vli_common.arrays import BoolArray, ByteArray, Float32Array, FloatArray
from vli_frontend.config import KltConfig

_CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 20, 0.01)
_BACKWARD_LEVELS = 1
"""The way back starts where the point came from: it only has to show that the match is mutual."""


def follow(previous: ByteArray, current: ByteArray, pixels: FloatArray, predicted: FloatArray, config: KltConfig) -> tuple[FloatArray, BoolArray]:
    """Track points from one image to the next.

    Args:
        previous, current: (H, W) uint8.
        pixels: (N, 2) in the previous image.
        predicted: (N, 2) where the search starts in the current one.
        config: window, pyramid, threshold.

    Returns:
        Positions (N, 2) in the current image, and (N,) True where found and back within ``forward_backward_px``.
    """
    if not len(pixels):
        return np.empty((0, 2)), np.empty(0, np.bool_)
    source = pixels.astype(np.float32)
    found, ok = _lucas_kanade(previous, current, source, predicted.astype(np.float32), config.window_px, config.pyramid_levels)
    back, ok_back = _lucas_kanade(current, previous, found, source, config.window_px, min(_BACKWARD_LEVELS, config.pyramid_levels))
    close = np.abs(back - source).max(axis=1) <= config.forward_backward_px
    return found.astype(np.float64), ok & ok_back & close


def _lucas_kanade(
    previous: ByteArray, current: ByteArray, source: Float32Array, start: Float32Array, window_px: int, levels: int
) -> tuple[Float32Array, BoolArray]:
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        previous,
        current,
        source,
        start.copy(),
        winSize=(window_px, window_px),
        maxLevel=levels,
        criteria=_CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    ok: BoolArray = status.ravel().astype(np.bool_)
    return found, ok
