"""Which corners to trust: weights while a fit is far from its end, yes or no once it is there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vli_common.arrays import BoolArray, FloatArray

_MEDIAN_OF_RAYLEIGH = 1.1774
_CAUCHY = 2.4
REJECT_SIGMAS = 4.0
"""A corner further off than this is not of the same kind: one in 3000 would be by chance."""
_FLOOR_PX = 0.02
_BLUR_AT_MOST = 1.5
_LEAST_VIEW_WEIGHT = 1 / 16


def axis_sigma(lengths: FloatArray) -> float:
    """Return the standard deviation per axis of errors in the plane from their lengths (N,), by the median."""
    return max(float(np.median(lengths)) / _MEDIAN_OF_RAYLEIGH, _FLOOR_PX)


def robust_weights(error: FloatArray, sigma: float | None = None) -> FloatArray:
    """Return Cauchy's weights (K,) of residuals (K, 2) in pixels; ``sigma`` per axis, by default their own."""
    lengths = np.linalg.norm(error, axis=1)
    scale = _CAUCHY * (axis_sigma(lengths) if sigma is None else sigma)
    weights: FloatArray = 1 / (1 + (lengths / scale) ** 2)
    return weights


def kept_corners(errors: Sequence[FloatArray]) -> list[BoolArray]:
    """Return, for each view, which of its residuals (K, 2) stay within :data:`REJECT_SIGMAS`.

    The scale is each view's own, so that a blurred view loses no more than a sharp one, but not beyond one and a half times
    that of all: what is worse is no blur.
    """
    lengths = [np.linalg.norm(error, axis=1) for error in errors]
    common = axis_sigma(np.concatenate(lengths))
    return [of_view <= REJECT_SIGMAS * np.clip(axis_sigma(of_view), common, _BLUR_AT_MOST * common) for of_view in lengths]


def view_weights(errors: Sequence[FloatArray], kept: Sequence[BoolArray]) -> FloatArray:
    """Return a weight for each view: its residuals' variance against that of all, so that blurred views count for less.

    At most 1: a view that happens to fit well is no better measured than the others.
    """
    lengths = [np.linalg.norm(error[rows], axis=1) for error, rows in zip(errors, kept, strict=True)]
    common = axis_sigma(np.concatenate(lengths))
    return np.array([np.clip((common / axis_sigma(of_view)) ** 2, _LEAST_VIEW_WEIGHT, 1.0) for of_view in lengths])
