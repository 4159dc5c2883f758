"""The pose of one long frame from the window's landmarks and the IMU's prediction.

Between keyframes the window is not solved; each frame gets its pose by a robust pose-only adjustment (PnP with a prior). The
uncertain depth of a landmark enters its residual's covariance: a young landmark fixes only what it can.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np

from vli_backend.rotations import exp, log
from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, pose, so3_exp

_INLIER_SQUARED = 18.0
"""Squared residual (2 dof, in sigmas) up to which a landmark counts as matched; the robust loss weighs it anyway."""
_ALONE_PX, _ALONE_ROUNDS, _ALONE_CONFIDENCE, _LEAST_ALONE = 3.0, 200, 0.999, 12
"""RANSAC without a prediction: error of an inlier, samples, confidence, inliers."""


@dataclass(frozen=True)
class FramePose:
    """Pose ``T_map_camera`` (4, 4), information (6, 6) of [ω, v] in the camera, inliers, their RMS in sigmas, iterations."""

    T_map_camera: FloatArray
    information: FloatArray
    inliers: int
    rms: float
    iterations: int


@numba.njit(cache=True, nogil=True)
def _weights(rotation, translation, points, spread, whitening):  # type: ignore[no-untyped-def]
    """Return the inverse covariances (N, 3: xx, xy, yy) of the residuals, (WᵀW)⁻¹ + d dᵀ with d the depth's spread on the rays.

    They are taken at the prediction and held: recomputed at every step they would reward a step away from it, where an unknown
    depth hides any error.
    """
    out = np.zeros((len(points), 3))
    for i in range(len(points)):
        x = rotation.T @ (points[i] - translation)
        d = rotation.T @ spread[i]
        if x[2] <= 1e-6:
            continue
        d0, d1 = (d[0] - x[0] / x[2] * d[2]) / x[2], (d[1] - x[1] / x[2] * d[2]) / x[2]
        m = whitening[i]
        a, c = m[0, 0] * m[0, 0] + m[1, 0] * m[1, 0], m[0, 1] * m[0, 1] + m[1, 1] * m[1, 1]
        b = m[0, 0] * m[0, 1] + m[1, 0] * m[1, 1]
        # Sherman–Morrison.
        q0, q1 = a * d0 + b * d1, b * d0 + c * d1
        f = 1.0 / (1.0 + d0 * q0 + d1 * q1)
        out[i, 0], out[i, 1], out[i, 2] = a - f * q0 * q0, b - f * q0 * q1, c - f * q1 * q1
    return out


@numba.njit(cache=True, nogil=True)
def _solve(rotation, translation, points, weights, rays, prior, cauchy, iterations):  # type: ignore[no-untyped-def]
    start_r, start_t = rotation.copy(), translation.copy()
    h, g = np.zeros((6, 6)), np.zeros(6)
    inliers, squares, done = 0, 0.0, 0
    j0, j1, delta, x = np.empty(6), np.empty(6), np.empty(6), np.empty(3)
    for step in range(iterations):
        done = step + 1
        delta[:3] = log(start_r.T @ rotation)
        delta[3:] = rotation.T @ (translation - start_t)
        h[:] = prior
        g[:] = prior @ delta
        inliers, squares = 0, 0.0
        for i in range(len(points)):
            for m in range(3):
                x[m] = 0.0
                for n in range(3):
                    x[m] += rotation[n, m] * (points[i, n] - translation[n])
            if x[2] <= 1e-6:
                continue
            z = 1.0 / x[2]
            u, v = x[0] * z, x[1] * z
            e0, e1 = u - rays[i, 0], v - rays[i, 1]
            a, b, c = weights[i, 0], weights[i, 1], weights[i, 2]
            squared = a * e0 * e0 + 2.0 * b * e0 * e1 + c * e1 * e1
            w = 1.0 / (1.0 + squared / (cauchy * cauchy))
            if squared < _INLIER_SQUARED:
                inliers += 1
                squares += squared
            j0[0], j0[1], j0[2] = u * v, -(1.0 + u * u), v
            j0[3], j0[4], j0[5] = -z, 0.0, u * z
            j1[0], j1[1], j1[2] = 1.0 + v * v, -u * v, -u
            j1[3], j1[4], j1[5] = 0.0, -z, v * z
            for m in range(6):
                p, q = w * (a * j0[m] + b * j1[m]), w * (b * j0[m] + c * j1[m])
                g[m] += p * e0 + q * e1
                for n in range(6):
                    h[m, n] += p * j0[n] + q * j1[n]
        update = -np.linalg.solve(h, g)
        translation = translation + rotation @ update[3:]
        rotation = rotation @ exp(update[:3])
        if np.abs(update[:3]).max() < 1e-7 and np.abs(update[3:]).max() < 1e-9:
            break
    # One Newton step of the polar decomposition: poses are chained from frame to frame, and rounding errors would grow.
    rotation = rotation @ (1.5 * np.eye(3) - 0.5 * rotation.T @ rotation)
    return rotation, translation, h, inliers, squares, done


def pose_by_features(points: FloatArray, rays: FloatArray, focal_px: float) -> FloatArray | None:
    """Return ``T_map_camera`` (4, 4) by the features alone (RANSAC), for where a prediction may be too far off to start from.

    Args:
        points: (N, 3) landmarks in map.
        rays: (N, 2) observed.
        focal_px: pixels a unit of rays.

    Returns:
        None where too few of them agree.
    """
    if len(points) < _LEAST_ALONE:
        return None
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points,
        rays,
        np.eye(3),
        None,
        iterationsCount=_ALONE_ROUNDS,
        reprojectionError=_ALONE_PX / focal_px,
        confidence=_ALONE_CONFIDENCE,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not found or inliers is None or len(inliers) < _LEAST_ALONE:
        return None
    return inverse(pose(so3_exp(turn.ravel().astype(np.float64)), shift.ravel().astype(np.float64)))


def solve_frame_pose(
    T_predicted: FloatArray,
    prior: FloatArray,
    points: FloatArray,
    spread: FloatArray,
    rays: FloatArray,
    whitening: FloatArray,
    cauchy: float,
    iterations: int = 10,
) -> FramePose:
    """Return the pose that minimises the robust reprojection error and the distance to the prediction.

    Args:
        T_predicted: (4, 4) ``T_map_camera``, start and mean of the prior.
        prior: (6, 6) information of the prediction, [ω, v] in the camera.
        points: (N, 3) landmarks in map.
        spread: (N, 3) one sigma of each landmark along its anchor's ray, in map.
        rays: (N, 2) observed.
        whitening: (N, 2, 2) of the rays, see :mod:`vli_backend.track_noise`.
        cauchy: in sigmas.
        iterations: at most.
    """
    rotation, translation = np.ascontiguousarray(T_predicted[:3, :3]), np.ascontiguousarray(T_predicted[:3, 3])
    weights = _weights(rotation, translation, points, spread, whitening)
    rotation, translation, h, inliers, squares, done = _solve(
        rotation, translation, points, weights, np.ascontiguousarray(rays), prior, cauchy, iterations
    )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return FramePose(T, h, int(inliers), float(np.sqrt(squares / max(1, 2 * inliers))), int(done))
