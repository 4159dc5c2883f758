"""A session aligned to the map by its stripes and its features together: Gauss-Newton on one motion of the whole session.

Stripes alone leave free what no slope tells of: on a flat key they slide. Features hold that, to a tenth of a millimetre; where
there are slopes the stripes are finer. Each counts by its sigma, so no direction needs to be chosen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.geometry import transform
from vli_mapping.place_recognition import Evidence
from vli_mapping.registration import Registration, Surface, compare, pairs, tree_of
from vli_mapping.reprojection import joined, moved, normal_equations

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


def align_session(target: Surface, source: Surface, evidence: Sequence[Evidence], T_map_session: FloatArray) -> Alignment:
    """Return the alignment near a hypothesis.

    Args:
        target: of the map.
        source: stripes of the session, in its frame.
        evidence: matches of its views.
        T_map_session: the hypothesis, (4, 4).
    """
    T, tree = T_map_session, tree_of(target)
    centre = transform(T, source.points).mean(axis=0)
    matches = joined([item.matches for item in evidence])
    views = np.concatenate([np.broadcast_to(item.T_session_camera, (len(item.matches), 4, 4)) for item in evidence])
    for step in range(_BY_FEATURES + _BY_BOTH):
        matrix, vector = normal_equations(matches, views, T, centre)
        if step >= _BY_FEATURES:
            gate = max(_WIDEST_M * _NARROWING ** (step - _BY_FEATURES), _TIGHTEST_M)
            points, normals = transform(T, source.points), source.normals @ T[:3, :3].T
            which, at = pairs(tree, target, points, normals, gate)
            more, further = _of_stripes(points[which], target.points[at], target.normals[at], centre)
            matrix, vector = matrix + more, vector + further
        T = moved(T, matrix, vector, centre)
    covariance = np.linalg.pinv(matrix, rcond=1e-12)
    worst = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:]).max()))
    return Alignment(T, worst, compare(tree, target, source, T))


def _of_stripes(
    points: FloatArray, targets: FloatArray, normals: FloatArray, centre: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return normal equations of the point-to-plane errors, eq. (4)."""
    jacobian = np.concatenate([np.cross(points - centre, normals), normals], axis=1)
    error = np.einsum("ni,ni->n", targets - points, normals)
    weight = 1.0 / (_STRIPE_M**2 * _STRIPE_COPIES)
    return weight * jacobian.T @ jacobian, weight * jacobian.T @ error
