"""How one map lies in another: coarsely by the shape around their points, finely by point-to-plane ICP.

Both maps are levelled by gravity, so that four unknowns are left for the coarse part: heading and place. A pair of matched points
gives them; matches come from fast point feature histograms (Rusu et al., "Fast point feature histograms (FPFH) for 3D
registration", 2009) with the colour beside them. Things repeat (a keyboard's keys every 19 mm): of several candidates the one in
which most of the overlap agrees in place, normal and local contrast wins, and only by a margin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vli_common.arrays import Float32Array, FloatArray, IntArray
from vli_common.errors import InputError
from vli_common.geometry import inverse, pose, so3_exp, transform
from vli_mapping.thinning import thin_to_voxel

if TYPE_CHECKING:
    from scipy.spatial import KDTree

ICP_VOXEL_M = 5e-4
"""Of the surfaces that are compared: a point each, so that dense parts do not outweigh the rest."""
_KEYPOINT_M, _SHAPE_M = 1.5e-3, 5e-3
_BINS = 11
_PAIRS = 1 << 18
"""Of points whose angles are found at a time."""
_COLOUR_WEIGHT = 1.0
"""Of a colour's distance, full scale, against that of the histograms."""
_TRIES = 4000
_LOOSE_M, _TIGHT_M = 1.5e-3, 3e-4
_CANDIDATES = 5
_DISTINCT_M = 3e-3
_MARGIN = 1.5
_MIN_OVERLAP = 200
_MIN_LIKENESS = 0.43
"""Where colours tell of it: right joins have 0.58 to 0.87, those on a wrong key or on another face up to 0.29."""
_MIN_SHAPE, _MIN_PLAIN_SHAPE = 0.8, 0.95
"""Share of the overlap that must agree in place and normal, and where nothing else tells: in right joins 0.95 to 0.99, on a wrong
key up to 0.88, on another face of a machined part up to 0.92, of small overlaps 0.95. So plain parts are told by their rivals."""
_ICP_STEPS = 30
_MAX_ANGLE_COSINE = 0.7
_MAX_COLOUR = 60.0
_SURROUNDINGS_M = 6e-3
_FAINT, _STRONG = 8.0, 20.0
"""Grey levels of a contrast: the standard deviation below which it is mostly noise (of some 6), and where more is no more."""
_SAME_M = 1.5e-4
"""Farther from the plane than this, a point is not where the other map has it."""


@dataclass(frozen=True, slots=True)
class Surface:
    """Points (N, 3) with unit normals (N, 3) and colours (N, 3), one a voxel."""

    points: FloatArray
    normals: FloatArray
    colours: Float32Array


@dataclass(frozen=True, slots=True)
class Registration:
    """How a source lies in a target.

    Args:
        T_target_source: (4, 4).
        rms_m: of the point-to-plane distances of the overlap.
        overlap: points of the source that the target has too.
        shape: share of these that agree in place and normal.
        agreeing: share that agrees in place, normal and colour.
        likeness: see :func:`likeness`, of those that agree in place and normal.
    """

    T_target_source: FloatArray
    rms_m: float
    overlap: int
    shape: float
    agreeing: float
    likeness: float

    @property
    def score(self) -> float:
        """How much speaks for it: a large overlap that disagrees speaks for nothing."""
        looks = 1.0 if np.isnan(self.likeness) else max(self.likeness, 0.0)
        return self.overlap * max(self.shape - _MIN_SHAPE, 0.0) * looks

    @property
    def doubt(self) -> str:
        """Why it is not to be believed, in words; empty where it is."""
        plain = np.isnan(self.likeness)
        least = _MIN_PLAIN_SHAPE if plain else _MIN_SHAPE
        if self.overlap < _MIN_OVERLAP:
            return f"share only '{self.overlap}' points, one a {1e3 * ICP_VOXEL_M:g} mm voxel, expected '{_MIN_OVERLAP}'"
        if self.shape < least:
            return f"have the same shape in '{100 * self.shape:.0f}' % of what they share, expected '{100 * least:.0f}'"
        if not plain and self.likeness < _MIN_LIKENESS:
            return f"look alike to '{self.likeness:.2f}' where they have the same shape, expected '{_MIN_LIKENESS:.2f}'"
        return ""


def register(target: Surface, source: Surface, seed: int = 0) -> Registration:
    """Return how ``source`` lies in ``target``.

    Args:
        target, source: in frames that are levelled and metric, and share a part.
        seed: of the random choices.

    Raises:
        InputError: they share too little, or could lie in each other in more than one way.
    """
    found = [refine(target, source, T) for T in [np.eye(4), *candidates(target, source, np.random.default_rng(seed))]]
    found.sort(key=lambda item: -item.score)
    best = found[0]
    if best.doubt:
        raise InputError(f"maps {best.doubt}; scan more of what both have")
    centre = source.points.mean(axis=0)
    for other in found[1:]:
        apart = np.linalg.norm(transform(other.T_target_source @ inverse(best.T_target_source), centre[None]) - centre)
        if apart > _DISTINCT_M and other.score * _MARGIN > best.score:
            raise InputError(
                f"maps fit into each other in two ways '{1e3 * apart:.0f}' mm apart, expected one; scan more of what both have"
            )
    return best


def refine(target: Surface, source: Surface, T_target_source: FloatArray) -> Registration:
    """Return the nearest registration by point-to-plane ICP whose gate closes from 1.5 to 0.3 mm."""
    T, tree = T_target_source, tree_of(target)
    for step in range(_ICP_STEPS):
        gate = max(_LOOSE_M * 0.85**step, _TIGHT_M)
        points, normals = transform(T, source.points), source.normals @ T[:3, :3].T
        which, at = pairs(tree, target, points, normals, gate)
        if len(which) < 6:
            break
        T = _step(points[which], target.points[at], target.normals[at]) @ T
    return compare(tree, target, source, T)


def tree_of(surface: Surface) -> KDTree:
    """Return what finds the nearest point of a surface."""
    from scipy.spatial import KDTree

    return KDTree(surface.points)


def compare(tree: KDTree, target: Surface, source: Surface, T: FloatArray) -> Registration:
    """Return how a source, moved by ``T`` (4, 4), agrees with a target; ``tree`` is of the target."""
    points, normals = transform(T, source.points), source.normals @ T[:3, :3].T
    distance, nearest = _nearest(tree, points, 2 * _TIGHT_M)
    near = np.flatnonzero(np.isfinite(distance))
    at = nearest[near]
    if not len(near):
        return Registration(T, 0.0, 0, 0.0, 0.0, np.nan)
    off = np.einsum("ni,ni->n", points[near] - target.points[at], target.normals[at])
    shape = np.einsum("ni,ni->n", normals[near], target.normals[at]) > _MAX_ANGLE_COSINE
    shape &= np.abs(off) < _SAME_M
    ours, theirs = source.colours[near], target.colours[at]
    agree = shape & ~(np.abs(ours - theirs).max(axis=1) > _MAX_COLOUR)
    looks = likeness(points[near][shape], ours[shape], theirs[shape])
    rms = float(np.sqrt((off**2).mean()))
    return Registration(T, rms, len(near), float(shape.mean()), float(agree.mean()), looks)


def likeness(points: FloatArray, ours: Float32Array, theirs: Float32Array) -> float:
    """Return the correlation of the local contrast of two maps; NaN where it is too faint to tell, or few points have colours.

    What is equal wherever a thing repeats, or is nowhere marked, does not count: brightness is compared with the mean of its
    surroundings. Nor do flanks that the light grazed dominate: there a map's colour may be off by any amount.

    Args:
        points: (N, 3), where both have one.
        ours, theirs: (N, 3) colours there, NaN where not known.
    """
    known = np.isfinite(ours[:, 0]) & np.isfinite(theirs[:, 0])
    if known.sum() < _MIN_OVERLAP:
        return np.nan
    _, cell = np.unique(np.floor(points[known] / _SURROUNDINGS_M).astype(np.int64), axis=0, return_inverse=True)
    a, b = (_contrast(colours[known].mean(axis=1), cell.reshape(-1)) for colours in (ours, theirs))
    if min(a.std(), b.std()) < _FAINT:
        return np.nan
    return float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum()))


def _contrast(grey: Float32Array, cell: IntArray) -> FloatArray:
    """Return values (N,) less the mean of their cell, clipped."""
    mean = np.bincount(cell, grey) / np.maximum(np.bincount(cell), 1)
    return np.clip(grey - mean[cell], -_STRONG, _STRONG)


def surface_of(points: FloatArray, normals: Float32Array, colours: Float32Array, weights: Float32Array, edge: float) -> Surface:
    """Return the heaviest point with a normal of each voxel of ``edge`` metres."""
    flat = np.flatnonzero(normals.any(axis=1))
    which = flat[thin_to_voxel(points[flat], weights[flat], edge)]
    return Surface(points[which], normals[which].astype(np.float64), colours[which])


def _nearest(tree: KDTree, points: FloatArray, reach: float = np.inf) -> tuple[FloatArray, IntArray]:
    """Return distance and index (N,) of the nearest point of a tree; infinite, and past the end, beyond ``reach``."""
    distance, index = tree.query(points, distance_upper_bound=reach)
    return np.asarray(distance, np.float64), np.asarray(index, np.int64)


def pairs(tree: KDTree, target: Surface, points: FloatArray, normals: FloatArray, gate: float) -> tuple[IntArray, IntArray]:
    """Return which points have a target point within ``gate`` with a like normal, and which that is."""
    distance, nearest = _nearest(tree, points, gate)
    which = np.flatnonzero(np.isfinite(distance))
    like = np.einsum("ni,ni->n", normals[which], target.normals[nearest[which]]) > _MAX_ANGLE_COSINE
    return which[like], nearest[which[like]]


def _step(points: FloatArray, targets: FloatArray, normals: FloatArray) -> FloatArray:
    """Return the small motion (4, 4) that brings points (N, 3) nearest to the planes; directions no plane tells of stay."""
    centre = points.mean(axis=0)
    jacobian = np.concatenate([np.cross(points - centre, normals), normals], axis=1)
    residual = np.einsum("ni,ni->n", targets - points, normals)
    # In metres and in radians at the edge of the overlap: one scale for the cut-off.
    size = float(np.linalg.norm(points - centre, axis=1).max()) or 1.0
    scale = np.array([1 / size] * 3 + [1.0] * 3)
    solution = scale * np.linalg.lstsq(jacobian * scale, residual, rcond=1e-3)[0]
    motion = pose(so3_exp(solution[:3]), np.zeros(3))
    motion[:3, 3] = centre - motion[:3, :3] @ centre + solution[3:]
    return motion


def candidates(target: Surface, source: Surface, rng: np.random.Generator) -> list[FloatArray]:
    """Return up to five distinct transforms with the most matches of features in place, best first."""
    a, b = _keypoints(source), _keypoints(target)
    first, second = _matches(describe(a), describe(b))
    p, q = a.points[first], b.points[second]
    if len(p) < 2:
        return []
    i, j = rng.integers(len(p), size=(2, _TRIES))
    along_p, along_q = p[j] - p[i], q[j] - q[i]
    length = np.hypot(along_p[:, 0], along_p[:, 1])
    possible = (length > _SHAPE_M) & (np.abs(along_p[:, 2] - along_q[:, 2]) < _LOOSE_M)
    possible &= np.abs(length - np.hypot(along_q[:, 0], along_q[:, 1])) < _LOOSE_M
    heading = np.arctan2(along_q[:, 1], along_q[:, 0]) - np.arctan2(along_p[:, 1], along_p[:, 0])
    ranked: list[tuple[int, FloatArray]] = []
    for k in np.flatnonzero(possible):
        T = pose(so3_exp(np.array([0.0, 0.0, heading[k]])), np.zeros(3))
        T[:3, 3] = (q[i[k]] + q[j[k]]) / 2 - T[:3, :3] @ ((p[i[k]] + p[j[k]]) / 2)
        ranked.append((int((((transform(T, p) - q) ** 2).sum(axis=1) < _LOOSE_M**2).sum()), T))
    ranked.sort(key=lambda item: -item[0])
    return _distinct([T for _, T in ranked], p.mean(axis=0))


def _distinct(transforms: list[FloatArray], centre: FloatArray) -> list[FloatArray]:
    kept: list[FloatArray] = []
    for T in transforms:
        place = transform(T, centre[None])
        if all(np.linalg.norm(transform(other, centre[None]) - place) > _DISTINCT_M for other in kept):
            kept.append(T)
        if len(kept) == _CANDIDATES:
            break
    return kept


def _keypoints(surface: Surface) -> Surface:
    which = thin_to_voxel(surface.points, np.ones(len(surface.points), np.float32), _KEYPOINT_M)
    return Surface(surface.points[which], surface.normals[which], surface.colours[which])


def _matches(a: FloatArray, b: FloatArray) -> tuple[IntArray, IntArray]:
    """Return the pairs of rows that are nearest to each other."""
    from scipy.spatial import KDTree

    if not len(a) or not len(b):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    to_b, to_a = _nearest(KDTree(b), a)[1], _nearest(KDTree(a), b)[1]
    first = np.flatnonzero(to_a[to_b] == np.arange(len(a)))
    return first, to_b[first]


def describe(surface: Surface) -> FloatArray:
    """Return (N, 39): the FPFH of the points within 5 mm around each (33), their mean colour (3) and its spread (3).

    Points of no known colour, NaN, do not count for the colour; black where there are no others.
    """
    from scipy.sparse import csr_array
    from scipy.spatial import KDTree

    count = len(surface.points)
    pairs = KDTree(surface.points).query_pairs(_SHAPE_M, output_type="ndarray")
    # In pieces: of a large part the pairs are many times its points.
    simple = np.zeros(3 * _BINS * count)
    for piece in np.array_split(pairs, len(pairs) // _PAIRS + 1):
        i, j = np.concatenate([piece, piece[:, ::-1]]).T
        for feature, value in enumerate(_angles(surface, i, j)):
            column = np.clip((value * _BINS).astype(np.int64), 0, _BINS - 1) + feature * _BINS
            simple += np.bincount(i * 3 * _BINS + column, minlength=len(simple))
    i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
    share = 1.0 / np.maximum(np.bincount(i, minlength=count), 1)
    histograms = simple.reshape(count, -1) * share[:, None]
    near = 1.0 / (1.0 + np.linalg.norm(surface.points[i] - surface.points[j], axis=1) / _KEYPOINT_M)
    full = histograms + csr_array((near * share[i], (i, j)), shape=(count, count)) @ histograms
    full /= np.maximum(np.linalg.norm(full, axis=1, keepdims=True), 1e-9)
    known = np.isfinite(surface.colours[:, 0])
    colours = np.where(known[:, None], surface.colours, 0.0).astype(np.float64) / 255
    average = csr_array((share[i], (i, j)), shape=(count, count))
    of_known = np.maximum(np.bincount(i, share[i] * known[j], count), 1e-9)[:, None]
    mean = average @ colours / of_known
    spread = np.sqrt(np.maximum(average @ colours**2 / of_known - mean**2, 0.0))
    return np.concatenate([full, _COLOUR_WEIGHT * mean, _COLOUR_WEIGHT * spread], axis=1)


def _angles(surface: Surface, i: IntArray, j: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the three angles of each pair in the frame of Darboux, each scaled to [0, 1]."""
    u, n = surface.normals[i], surface.normals[j]
    d = surface.points[j] - surface.points[i]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    v = np.cross(u, d)
    v /= np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9)
    w = np.cross(u, v)
    alpha, phi = np.einsum("ni,ni->n", v, n), np.einsum("ni,ni->n", u, d)
    theta = np.arctan2(np.einsum("ni,ni->n", w, n), np.einsum("ni,ni->n", u, n))
    return (alpha + 1) / 2, (phi + 1) / 2, (theta / np.pi + 1) / 2
