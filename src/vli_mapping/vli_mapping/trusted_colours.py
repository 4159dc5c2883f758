"""Colours for places around which no colour can be trusted: those of the nearest that can.

A flank that the light grazes may be doubted over millimetres: its points have no normals, or the light on them is a guess, and
so it is with their neighbours. They are then dark in one pass and bright in the next, as the light happens to fall. The parts of
most things are larger than that and of one colour, so the nearest trusted points are the better guess: weighed by trust and
inverse square distance (Shepard, "A two-dimensional interpolation function for irregularly-spaced data", 1968).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from vli_common.arrays import Float32Array, FloatArray, IntArray
from vli_mapping.normals import SPARSE

_TRUSTED = 0.5
"""Trust from which on a colour is asked for, and needs none from afar."""
_NEAREST, _REACH_M, _SOFTENED_M = 16, 0.02, 3e-4
"""How many are asked, how far away at most, and the distance within which all count alike."""
_CHUNK = 1 << 17
"""Points that are looked up at a time."""


def from_afar(points: FloatArray, colours: Float32Array, trust: Float32Array) -> Float32Array:
    """Return for each point what the nearest trusted ones say (N, 3); NaN where it is trusted itself, or none is near.

    Args:
        points: (N, 3), metres.
        colours: (N, 3), NaN = unknown.
        trust: (N,), inverse of the doubt of each colour.
    """
    result = np.full_like(colours, np.nan)
    known = ~np.isnan(colours[:, 0])
    trusted = np.flatnonzero(known & (trust > _TRUSTED))[::SPARSE]
    asking = np.flatnonzero(known & (trust <= _TRUSTED))
    if len(trusted) < _NEAREST:
        return result
    tree = KDTree(points[trusted])
    for start in range(0, len(asking), _CHUNK):
        which = asking[start : start + _CHUNK]
        result[which] = _mean_of_nearest(tree, points[which], trusted, colours, trust)
    return result


def _mean_of_nearest(
    tree: KDTree, points: FloatArray, trusted: IntArray, colours: Float32Array, trust: Float32Array
) -> FloatArray:
    distance, nearest = tree.query(points, _NEAREST, distance_upper_bound=_REACH_M)
    is_near = np.isfinite(distance)
    rows = trusted[np.where(is_near, nearest, 0)]
    weight = np.where(is_near, trust[rows] / (distance**2 + _SOFTENED_M**2), 0.0)
    with np.errstate(invalid="ignore"):
        result: FloatArray = np.einsum("nk,nkc->nc", weight, colours[rows]) / weight.sum(axis=1)[:, None]
    return result
