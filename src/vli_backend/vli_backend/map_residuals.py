"""Window to map, eq. (4): point-to-plane residuals of the stripes in the window, condensed to the keyframe poses.

Each stripe is rigid; its pose is the interpolation between the adjacent keyframes times the measured deviation δ (see
``window``). The points of one stripe are first summed into a 6×6 system of the stripe's pose, then mapped to the two keyframes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np

from vli_backend.condense import Quadratic
from vli_backend.rotations import exp, inverse_right_jacobian, log, right_jacobian, skew
from vli_backend.window import Interval
from vli_common.arrays import FloatArray, IntArray
from vli_common.geometry import interpolate
from vli_common.types import MapConstraints


@numba.njit(cache=True, nogil=True)
def stripe_jacobian(T0: FloatArray, T1: FloatArray, alpha: float, delta: FloatArray) -> FloatArray:
    """Return d[ω_s, v_s] / d[ω_0, v_0, ω_1, v_1] (6, 12) of T_s = interp(T0, T1, α) δ; right perturbations throughout."""
    r0, r1 = T0[:3, :3].copy(), T1[:3, :3].copy()
    phi = log(r0.T @ r1)
    e = exp(alpha * phi)
    r = r0 @ e
    scaled = alpha * right_jacobian(alpha * phi)
    out = np.zeros((6, 12))
    out[:3, :3] = e.T - scaled @ inverse_right_jacobian(-phi)
    out[:3, 6:9] = scaled @ inverse_right_jacobian(phi)
    out[3:, 3:6] = (1.0 - alpha) * (r.T @ r0)
    out[3:, 9:] = alpha * (r.T @ r1)
    # T Exp(ξ) δ = T δ Exp(Ad_{δ⁻¹} ξ)
    back = delta[:3, :3].T.copy()
    adjoint = np.zeros((6, 6))
    adjoint[:3, :3] = back
    adjoint[3:, 3:] = back
    adjoint[3:, :3] = skew(-(back @ delta[:3, 3].copy())) @ back
    return adjoint @ out


@numba.njit(cache=True, nogil=True)
def _stripe_system(T, points, targets, normals, information, cauchy):  # type: ignore[no-untyped-def]
    """Return H (6, 6), g (6,) and the cost of one stripe's residuals r = n · (T v − v^g), [ω, v] of the stripe's pose T."""
    h, g, cost = np.zeros((6, 6)), np.zeros(6), 0.0
    row, m = np.empty(6), np.empty(3)
    for i in range(len(points)):
        p, n = points[i], normals[i]
        residual = 0.0
        for a in range(3):
            residual += n[a] * (T[a, 0] * p[0] + T[a, 1] * p[1] + T[a, 2] * p[2] + T[a, 3] - targets[i, a])
            m[a] = T[0, a] * n[0] + T[1, a] * n[1] + T[2, a] * n[2]
        squared = residual * residual * information[i]
        w = information[i] / (1.0 + squared / (cauchy * cauchy))
        cost += cauchy * cauchy * np.log1p(squared / (cauchy * cauchy))
        row[0], row[1], row[2] = p[1] * m[2] - p[2] * m[1], p[2] * m[0] - p[0] * m[2], p[0] * m[1] - p[1] * m[0]
        row[3], row[4], row[5] = m[0], m[1], m[2]
        for a in range(6):
            g[a] += w * row[a] * residual
            for b in range(6):
                h[a, b] += w * row[a] * row[b]
    return h, g, cost


@numba.njit(cache=True, nogil=True)
def _condense_stripes(  # type: ignore[no-untyped-def]
    keyframes, poses, slots, alphas, deltas, starts, ends, points, targets, normals, information, cauchy, hessian, gradient
):
    cost = 0.0
    for s in range(len(slots)):
        a, b, k = starts[s], ends[s], slots[s]
        h, g, c = _stripe_system(poses[s], points[a:b], targets[a:b], normals[a:b], information[a:b], cauchy)
        jacobian = stripe_jacobian(keyframes[k], keyframes[k + 1], alphas[s], deltas[s])
        hessian[6 * k : 6 * k + 12, 6 * k : 6 * k + 12] += jacobian.T @ h @ jacobian
        gradient[6 * k : 6 * k + 12] += jacobian.T @ g
        cost += c
    return cost


def condense_map(
    constraints: MapConstraints,
    stamps: Sequence[int],
    intervals: Sequence[Interval],
    use: range,
    T_map_camera: FloatArray,
    sigma_scale: float,
    cauchy: float,
) -> Quadratic:
    """Return eq. (4) over the camera poses (K, 4, 4) of the window; stripes that are not in the window any more are left out.

    Args:
        constraints: correspondences, held fixed.
        stamps: of the K keyframes.
        intervals: the K − 1 intervals between them.
        use: which of the intervals take part.
        T_map_camera: linearisation point.
        sigma_scale: factor on the points' sigmas, for their correlation.
        cauchy: in sigmas.
    """
    size = 6 * len(T_map_camera)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    order = np.argsort(constraints.scan_stamps, kind="stable")
    scan_stamps, starts = np.unique(constraints.scan_stamps[order], return_index=True)
    ends = np.append(starts[1:], len(order))
    slots, indices = _locate(scan_stamps, stamps, intervals, use)
    found = indices >= 0
    slots, indices = slots[found], indices[found]
    if not len(slots):
        return Quadratic(hessian, gradient, 0.0)
    alphas = np.array([intervals[k].alpha[i] for k, i in zip(slots, indices, strict=True)])
    deltas = np.stack([intervals[k].delta[i] for k, i in zip(slots, indices, strict=True)])
    poses = interpolate(T_map_camera[slots], T_map_camera[slots + 1], alphas) @ deltas
    information = constraints.weight / (sigma_scale * constraints.sigma) ** 2
    columns = (constraints.points_camera, constraints.points_map, constraints.normals_map, information)
    stripes = (T_map_camera, poses, slots, alphas, deltas, starts[found], ends[found])
    sorted_columns = (np.ascontiguousarray(column[order]) for column in columns)
    cost = _condense_stripes(*stripes, *sorted_columns, cauchy, hessian, gradient)  # type: ignore[call-arg]
    return Quadratic(hessian, gradient, float(cost))


def _locate(scan_stamps: IntArray, stamps: Sequence[int], intervals: Sequence[Interval], use: range) -> tuple[IntArray, IntArray]:
    """Return the interval of each scan and its index there, −1 where it is in none of those used."""
    slots = np.searchsorted(np.asarray(stamps), scan_stamps, side="right") - 1
    indices = np.full(len(scan_stamps), -1)
    for k in use:
        inside = np.flatnonzero(slots == k)
        at = np.searchsorted(intervals[k].stamps, scan_stamps[inside])
        known = at < len(intervals[k].stamps)
        known[known] = intervals[k].stamps[at[known]] == scan_stamps[inside][known]
        indices[inside[known]] = at[known]
    return slots, indices
