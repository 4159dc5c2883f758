"""Pyramidal Lucas–Kanade with a forward–backward check (Bouguet, 2001; Kalal et al., 2010)."""

from __future__ import annotations

from typing import cast

import cv2
import numpy as np

from vli_common.arrays import BoolArray, ByteArray, Float32Array, FloatArray
from vli_frontend.config import KltConfig
from vli_frontend.photometry import Frame

_CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 20, 0.01)
_BACKWARD_LEVELS = 0
"""The way back starts where the point came from: it only has to show that the match is mutual."""
_SCALE = 0.5


def follow(
    previous: Frame, current: Frame, pixels: FloatArray, predicted: FloatArray, config: KltConfig
) -> tuple[FloatArray, BoolArray]:
    """Track points from one frame to the next, on the normalised images of half the size.

    Args:
        previous, current: frames.
        pixels: (N, 2) in the previous frame, full size.
        predicted: (N, 2) where the search starts in the current one.
        config: window and pyramid (full size), threshold.

    Returns:
        Positions (N, 2) in the current frame, and (N,) True where found and back within ``forward_backward_px``.
    """
    if not len(pixels):
        return np.empty((0, 2)), np.empty(0, np.bool_)
    window, levels = 2 * (config.window_px // 4) + 1, max(config.pyramid_levels - 1, 0)
    source, start = (_SCALE * pixels).astype(np.float32), (_SCALE * predicted).astype(np.float32)
    found, ok = _lucas_kanade(previous.normalised, current.normalised, source, start, window, levels)
    back, ok_back = _lucas_kanade(current.normalised, previous.normalised, found, source, window, _BACKWARD_LEVELS)
    close = np.abs(back - source).max(axis=1) <= _SCALE * config.forward_backward_px
    return found.astype(np.float64) / _SCALE, ok & ok_back & close


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
    return cast(Float32Array, found), ok
