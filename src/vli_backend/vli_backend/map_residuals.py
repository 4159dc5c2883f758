"""Window to map, eq. (4): point-to-plane residuals of the stripes in the window, condensed to the keyframe poses.

Each stripe is rigid; its pose is the interpolation between the adjacent keyframes times the measured deviation δ (see
``window``). The points of one stripe are first summed into a 6×6 system of the stripe's pose, then mapped to the two keyframes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vli_backend.condense import Quadratic
from vli_backend.window import Interval
from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, skew, so3_exp, so3_log, so3_right_jacobian
from vli_common.types import MapConstraints


def stripe_jacobian(T0: FloatArray, T1: FloatArray, alpha: float, delta: FloatArray) -> FloatArray:
    """Return d[ω_s, v_s] / d[ω_0, v_0, ω_1, v_1] (6, 12) of T_s = interp(T0, T1, α) δ; right perturbations throughout."""
    r0, r1 = T0[:3, :3], T1[:3, :3]
    phi = so3_log(r0.T @ r1)
    e = so3_exp(alpha * phi)
    r = r0 @ e
    jr = so3_right_jacobian(alpha * phi)
    out = np.zeros((6, 12))
    out[:3, :3] = e.T - alpha * jr @ np.linalg.inv(so3_right_jacobian(-phi))
    out[:3, 6:9] = alpha * jr @ np.linalg.inv(so3_right_jacobian(phi))
    out[3:, 3:6] = (1 - alpha) * r.T @ r0
    out[3:, 9:] = alpha * r.T @ r1
    # T Exp(ξ) δ = T δ Exp(Ad_{δ⁻¹} ξ)
    back = inverse(delta)
    adjoint = np.zeros((6, 6))
    adjoint[:3, :3] = adjoint[3:, 3:] = back[:3, :3]
    adjoint[3:, :3] = skew(back[:3, 3]) @ back[:3, :3]
    result: FloatArray = adjoint @ out
    return result


def stripe_system(
    T: FloatArray, points: FloatArray, targets: FloatArray, normals: FloatArray, information: FloatArray, cauchy: float
) -> tuple[FloatArray, FloatArray, float]:
    """Return H (6, 6), g (6,) and the cost of one stripe's residuals r = n · (T v − v^g), [ω, v] of the stripe's pose.

    Args:
        T: (4, 4) ``T_map_camera`` of the stripe.
        points: (N, 3) v in the camera.
        targets, normals: (N, 3) v^g, n^g in the map.
        information: (N,) 1/m².
        cauchy: in sigmas.
    """
    residual = np.einsum("ni,ni->n", normals, points @ T[:3, :3].T + T[:3, 3] - targets)
    squared = residual**2 * information
    weight = information / (1.0 + squared / cauchy**2)
    local = normals @ T[:3, :3]
    rows = np.concatenate([np.cross(points, local), local], axis=1)
    weighted = rows * weight[:, None]
    return weighted.T @ rows, weighted.T @ residual, float(cauchy**2 * np.log1p(squared / cauchy**2).sum())


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
    count = len(T_map_camera)
    hessian, gradient, cost = np.zeros((6 * count, 6 * count)), np.zeros(6 * count), 0.0
    order = np.argsort(constraints.scan_stamps, kind="stable")
    scan_stamps, starts = np.unique(constraints.scan_stamps[order], return_index=True)
    ends = [*starts[1:], len(order)]
    slots = np.searchsorted(np.asarray(stamps), scan_stamps, side="right") - 1
    information = constraints.weight / (sigma_scale * constraints.sigma) ** 2
    for stamp, k, start, end in zip(scan_stamps, slots, starts, ends, strict=True):
        if k not in use:
            continue
        interval = intervals[k]
        index = int(np.searchsorted(interval.stamps, stamp))
        if index >= len(interval.stamps) or interval.stamps[index] != stamp:
            continue
        rows = order[start:end]
        delta, alpha = interval.delta[index], float(interval.alpha[index])
        jacobian = stripe_jacobian(T_map_camera[k], T_map_camera[k + 1], alpha, delta)
        pose = interval.poses(T_map_camera[k], T_map_camera[k + 1])[index]
        h, g, c = stripe_system(
            pose,
            constraints.points_camera[rows],
            constraints.points_map[rows],
            constraints.normals_map[rows],
            information[rows],
            cauchy,
        )
        span = slice(6 * k, 6 * k + 12)
        hessian[span, span] += jacobian.T @ h @ jacobian
        gradient[span] += jacobian.T @ g
        cost += c
    return Quadratic(hessian, gradient, cost)
