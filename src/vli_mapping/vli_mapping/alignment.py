"""A session aligned to the map by its stripes and its features together: Gauss-Newton on one motion of the whole session.

Stripes alone leave free what no slope tells of: on a flat key they slide. Features hold that, to a tenth of a millimetre; where
there are slopes the stripes are finer. Each counts by its sigma, so no direction needs to be chosen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, pose, skew, so3_exp, transform
from vli_mapping.place_recognition import Evidence
from vli_mapping.registration import Registration, Surface, compare, pairs, tree_of

_FEATURE_PX = 2.0
"""Sigma of a match: the corner at half resolution, and where the map has it."""
_FEATURE_COPIES = 4.0
"""Matches whose errors are one error: a corner is seen in several views, and remembered by several keyframes."""
_STRIPE_M, _STRIPE_COPIES = 1.0e-4, 25.0
"""Sigma of a point to its plane, and points whose errors are one error: that of the stripe's pose."""
_BY_FEATURES, _BY_BOTH = 10, 15
_WIDEST_M, _TIGHTEST_M, _NARROWING = 1.0e-3, 3e-4, 0.85


@dataclass(frozen=True, slots=True)
class Alignment:
    """Where a session came to lie.

    Args:
        T_map_session: (4, 4).
        sigma_m: of the position of the stripes' centre, in its worst direction.
        fit: how the stripes lie on the map there.
    """

    T_map_session: FloatArray
    sigma_m: float
    fit: Registration


def align_session(
    target: Surface, source: Surface, evidence: Sequence[Evidence], focal_px: float, T_map_session: FloatArray
) -> Alignment:
    """Return the alignment near a hypothesis.

    Args:
        target: of the map.
        source: stripes of the session, in its frame.
        evidence: matches of its views.
        focal_px: of the camera.
        T_map_session: the hypothesis, (4, 4).
    """
    T, tree = T_map_session, tree_of(target)
    centre = transform(T, source.points).mean(axis=0)
    features = _joined(evidence)
    sigma = _FEATURE_PX / focal_px
    for step in range(_BY_FEATURES + _BY_BOTH):
        matrix, vector = _of_features(features, T, centre, sigma)
        if step >= _BY_FEATURES:
            gate = max(_WIDEST_M * _NARROWING ** (step - _BY_FEATURES), _TIGHTEST_M)
            points, normals = transform(T, source.points), source.normals @ T[:3, :3].T
            which, at = pairs(tree, target, points, normals, gate)
            more, further = _of_stripes(points[which], target.points[at], target.normals[at], centre)
            matrix, vector = matrix + more, vector + further
        T = _motion(np.asarray(np.linalg.lstsq(matrix, vector, rcond=1e-12)[0], np.float64), centre) @ T
    covariance = np.linalg.pinv(matrix, rcond=1e-12)
    worst = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:]).max()))
    return Alignment(T, worst, compare(tree, target, source, T))


def _motion(delta: FloatArray, centre: FloatArray) -> FloatArray:
    """Return the motion (4, 4) that turns by a vector about ``centre`` (3,), then shifts; ``delta`` is (6,)."""
    motion = pose(so3_exp(delta[:3]), np.zeros(3))
    motion[:3, 3] = centre - motion[:3, :3] @ centre + delta[3:]
    return motion


@dataclass(frozen=True, slots=True)
class _Features:
    """Matches (M,) of all views: pose of the view, ray, point of the map."""

    T_session_camera: FloatArray
    rays: FloatArray
    points: FloatArray


def _joined(evidence: Sequence[Evidence]) -> _Features:
    poses = [np.broadcast_to(item.T_session_camera, (len(item.rays), 4, 4)) for item in evidence]
    return _Features(
        np.concatenate(poses),
        np.concatenate([item.rays for item in evidence]),
        np.concatenate([item.points for item in evidence]),
    )


def _of_features(features: _Features, T: FloatArray, centre: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Return normal equations of the reprojection errors, reweighted: matches are many, and some are wrong."""
    T_camera_map = inverse(T @ features.T_session_camera)
    local = transform(T_camera_map, features.points)
    ahead = local[:, 2] > 0
    x, y, z = local[ahead].T
    error = features.rays[ahead] - np.stack([x / z, y / z], axis=1)
    zero = np.zeros_like(z)
    projection = np.stack([np.stack([1 / z, zero, -x / z**2], axis=1), np.stack([zero, 1 / z, -y / z**2], axis=1)], axis=1)
    turn = T_camera_map[ahead, :3, :3]
    # The session moves, so the map moves the other way as the camera sees it.
    moved = np.concatenate([turn @ skew(features.points[ahead] - centre), -turn], axis=2)
    jacobian = projection @ moved
    weight = 1.0 / (1.0 + (error**2).sum(axis=1) / sigma**2) ** 2 / (sigma**2 * _FEATURE_COPIES)
    weighted = jacobian * weight[:, None, None]
    return np.einsum("nij,nik->jk", weighted, jacobian), np.einsum("nij,ni->j", weighted, error)


def _of_stripes(
    points: FloatArray, targets: FloatArray, normals: FloatArray, centre: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return normal equations of the point-to-plane errors, eq. (4)."""
    jacobian = np.concatenate([np.cross(points - centre, normals), normals], axis=1)
    error = np.einsum("ni,ni->n", targets - points, normals)
    weight = 1.0 / (_STRIPE_M**2 * _STRIPE_COPIES)
    return weight * jacobian.T @ jacobian, weight * jacobian.T @ error
