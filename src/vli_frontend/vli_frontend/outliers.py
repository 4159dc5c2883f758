"""Rejection of tracks that do not fit the motion of the camera between two frames.

With the rotation known from the gyroscope two points fix the direction of translation; a plane is no degenerate case then, and
where nothing translates every direction fits, so nothing is rejected. Without it, the essential matrix.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numba import njit

from vli_common.arrays import BoolArray, FloatArray, IntArray
from vli_common.camera import CameraModel

_MIN_POINTS = 8
_HYPOTHESES = 60
"""Enough for 99 % confidence of an all-inlier pair with 70 % outliers, 1 − (1 − 0.3²)^60."""
_CONFIDENCE = 0.99


class OutlierRejection:
    """Inliers of the epipolar geometry between consecutive frames.

    Args:
        camera: of the calibration.
        threshold_px: distance to the epipolar line, in the raw image: there the tracker's noise is the same all over.
    """

    def __init__(self, camera: CameraModel, threshold_px: float) -> None:
        self._camera, self._threshold_px = camera, threshold_px
        self._rng = np.random.default_rng(0)

    def reset(self) -> None:
        """Start the sequence of random choices anew."""
        self._rng = np.random.default_rng(0)

    def inliers(self, previous: FloatArray, current: FloatArray, rotation: FloatArray | None) -> BoolArray:
        """Return (N,) True for tracks that fit one motion.

        Args:
            previous, current: rays (N, 2).
            rotation: (3, 3) that turns directions of the previous camera into the current one, or None where unknown.
        """
        count = len(previous)
        if count < _MIN_POINTS:
            return np.ones(count, np.bool_)
        jacobians = self._camera.jacobian(current)
        if rotation is None:
            # OpenCV takes one threshold for all rays.
            px_per_ray = float(np.sqrt(np.median(np.linalg.det(jacobians))))
            return _essential_inliers(previous, current, self._threshold_px / px_per_ray)
        pairs = self._rng.integers(0, count, (_HYPOTHESES, 2))
        return translation_inliers(previous, current, jacobians, np.ascontiguousarray(rotation), pairs, self._threshold_px)


def _essential_inliers(previous: FloatArray, current: FloatArray, threshold: float) -> BoolArray:
    _, mask = cv2.findEssentialMat(previous, current, np.eye(3), method=cv2.RANSAC, prob=_CONFIDENCE, threshold=threshold)
    return np.ones(len(previous), np.bool_) if mask is None else mask.ravel().astype(np.bool_)


@njit(cache=True, nogil=True)
def translation_inliers(
    previous: FloatArray, current: FloatArray, jacobians: FloatArray, rotation: FloatArray, pairs: IntArray, threshold_px: float
) -> BoolArray:
    """Return (N,) True within ``threshold_px`` of the epipolar line of the best translation.

    Args:
        previous, current: rays (N, 2).
        jacobians: (N, 2, 2) d pixel / d ray at the current ones.
        rotation: (3, 3), previous camera → current one.
        pairs: (M, 2) indices, two points a hypothesis; scored by the truncated quadratic (MSAC, Torr and Zisserman, 2000).
        threshold_px: in the raw image.
    """
    turned = np.empty((len(previous), 3))
    for n in range(len(previous)):
        for i in range(3):
            turned[n, i] = rotation[i, 0] * previous[n, 0] + rotation[i, 1] * previous[n, 1] + rotation[i, 2]
    best, best_score = np.zeros(3), -1.0
    for m in range(len(pairs)):
        first, second = _epipolar_normal(turned, current, pairs[m, 0]), _epipolar_normal(turned, current, pairs[m, 1])
        direction = _cross(first, second)
        norm = math.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
        if norm < 1e-12:
            continue
        direction /= norm
        score = 0.0
        for n in range(len(previous)):
            error = _line_distance_px(turned[n], current[n], direction, jacobians[n]) / threshold_px
            score += max(0.0, 1.0 - error * error)
        if score > best_score:
            best, best_score = direction, score
    inliers = np.ones(len(previous), np.bool_)
    if best_score >= 0.0:
        for n in range(len(previous)):
            inliers[n] = _line_distance_px(turned[n], current[n], best, jacobians[n]) <= threshold_px
    return inliers


@njit(cache=True, nogil=True)
def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@njit(cache=True, nogil=True)
def _epipolar_normal(turned: FloatArray, current: FloatArray, n: int) -> FloatArray:
    return _cross(turned[n], np.array([current[n, 0], current[n, 1], 1.0]))


@njit(cache=True, nogil=True)
def _line_distance_px(turned: FloatArray, current: FloatArray, direction: FloatArray, jacobian: FloatArray) -> float:
    """Return the distance of a ray from the epipolar line of its (rotated) partner, pixels of the raw image, to first order.

    A line n·r = c of rays is J⁻ᵀ n · x = const on pixels.
    """
    a = direction[1] * turned[2] - direction[2] * turned[1]
    b = direction[2] * turned[0] - direction[0] * turned[2]
    c = direction[0] * turned[1] - direction[1] * turned[0]
    determinant = jacobian[0, 0] * jacobian[1, 1] - jacobian[0, 1] * jacobian[1, 0]
    norm = math.hypot(jacobian[1, 1] * a - jacobian[1, 0] * b, jacobian[0, 0] * b - jacobian[0, 1] * a)
    return abs((a * current[0] + b * current[1] + c) * determinant) / norm if norm > 1e-12 else 0.0
