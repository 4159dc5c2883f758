"""Corners to a hundredth of the square: which grey to look at, and how far round a corner."""

from __future__ import annotations

import cv2
import numpy as np

from vli_common.arrays import BoolArray, ByteArray, FloatArray

_WINDOW_OF_SIDE = 0.3
"""Half the search window over the distance to the nearest corner: enough edge, and stripes further off do no harm."""
_WINDOW_PX = (2, 30)
_BLUR_PX = 1.0
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-3)
_STRIPE_QUANTILE = 0.999
_STRIPE_EXCESS = 12.0


def board_grey(pixels: ByteArray) -> ByteArray:
    """Return the grey (H, W) in which a laser stripe shows least: of a colour image, the two channels without the laser.

    Args:
        pixels: (H, W, 3) BGR or (H, W) grey.
    """
    if pixels.ndim == 2:
        return pixels
    if pixels.shape[2] < 3:
        return np.ascontiguousarray(pixels[:, :, 0])
    laser = _laser_channel(pixels)
    if laser is None:
        return np.asarray(cv2.cvtColor(pixels[:, :, :3], cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    first, second = (np.ascontiguousarray(pixels[:, :, channel]) for channel in range(3) if channel != laser)
    return np.asarray(cv2.addWeighted(first, 0.5, second, 0.5, 0.0), dtype=np.uint8)


def _laser_channel(pixels: ByteArray) -> int | None:
    """Return the channel that stands out over both others in some thousandth of the image, more than elsewhere; None without."""
    thin = pixels[::2, ::2, :3].astype(np.int16)
    excess = [thin[:, :, c] - np.maximum(thin[:, :, c - 2], thin[:, :, c - 1]) for c in range(3)]
    contrast = [float(np.quantile(e, _STRIPE_QUANTILE) - np.median(e)) for e in excess]
    strongest = int(np.argmax(contrast))
    return strongest if contrast[strongest] > _STRIPE_EXCESS else None


def refine(grey: ByteArray, corners: FloatArray, neighbour_px: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the corners (N, 2) at their saddle points, and which of them (N,) stayed where they were found.

    The gradient condition of cv2.cornerSubPix, in windows that follow each corner's own square, so that a tilted board's far
    end gets smaller ones. A corner that runs further than its window was none.

    Args:
        grey: (H, W) image.
        corners: (N, 2) pixels, right to a fraction of a square.
        neighbour_px: (N,) distance to the nearest other corner, pixels.
    """
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _BLUR_PX)
    half = np.clip(np.rint(_WINDOW_OF_SIDE * neighbour_px), *_WINDOW_PX).astype(int)
    refined = corners.astype(np.float32)
    for size in np.unique(half):
        rows = half == size
        window = (int(size), int(size))
        refined[rows] = cv2.cornerSubPix(smooth, refined[rows].reshape(-1, 1, 2).copy(), window, (-1, -1), _STOP).reshape(-1, 2)
    moved = np.linalg.norm(refined - corners, axis=1)
    height, width = grey.shape
    inside = (refined > -0.5).all(axis=1) & (refined[:, 0] < width - 0.5) & (refined[:, 1] < height - 0.5)
    return refined.astype(np.float64), inside & (moved < np.maximum(0.3 * neighbour_px, 1.0))


def nearest_neighbour_px(corners: FloatArray) -> FloatArray:
    """Return the distance (N,) from each of the corners (N, 2) to the nearest other one; N ≥ 2."""
    distance = np.linalg.norm(corners[:, None] - corners[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    nearest: FloatArray = distance.min(axis=1)
    return nearest
