"""Residuals (2) and (3) of the window, condensed to its poses.

Each landmark is an inverse depth ρ along the ray of its anchor keyframe. Its reprojections into the other keyframes, eq. (3),
and its laser depth in the primary frame, eq. (2), depend on two poses and ρ; ρ is eliminated by a Schur complement, so that a
landmark leaves only a quadratic in the poses. Elimination happens at the optimal ρ, which makes it a variable projection: the
poses converge as if depths were solved with them.

Tangent vectors are ``[ω, v]`` of right perturbations of the camera poses ``T_map_camera``. All residuals are in units of their
standard deviation, with Cauchy weights.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numba
import numpy as np

from vli_common.arrays import AnyArray, BoolArray, FloatArray
from vli_common.geometry import skew


@dataclass(frozen=True)
class Quadratic:
    """The quadratic ½ δᵀ H δ + gᵀ δ + ½ c over K poses: H (6K, 6K), g (6K,), c = Σ residual²."""

    hessian: FloatArray
    gradient: FloatArray
    constant: float

    def __add__(self, other: Quadratic) -> Quadratic:
        """Return the sum of two quadratics at the same linearisation point."""
        return Quadratic(self.hessian + other.hessian, self.gradient + other.gradient, self.constant + other.constant)

    def in_body_frame(self, T_cam_imu: FloatArray) -> Quadratic:
        """Return the quadratic in perturbations of ``T_map_imu`` instead of ``T_map_camera``."""
        rotation, translation = T_cam_imu[:3, :3], T_cam_imu[:3, 3]
        adjoint = np.zeros((6, 6))
        adjoint[:3, :3] = adjoint[3:, 3:] = rotation
        adjoint[3:, :3] = skew(translation) @ rotation
        hessian: FloatArray = _congruent(self.hessian, adjoint)
        gradient = (self.gradient.reshape(-1, 6) @ adjoint).reshape(-1)
        return Quadratic(hessian, gradient, self.constant)


@numba.njit(cache=True, nogil=True)
def _congruent(hessian, adjoint):  # type: ignore[no-untyped-def]
    """Return Aᵀ H A for every 6 × 6 block."""
    out = np.empty(hessian.shape)
    for i in range(0, len(hessian), 6):
        for j in range(0, len(hessian), 6):
            out[i : i + 6, j : j + 6] = adjoint.T @ np.ascontiguousarray(hessian[i : i + 6, j : j + 6]) @ adjoint
    return out


@numba.njit(cache=True, nogil=True)
def _relative_poses(rotations, translations):  # type: ignore[no-untyped-def]
    """Return R_ja (K, K, 3, 3) and t_ja (K, K, 3): points of frame a in frame j."""
    count = len(rotations)
    r, t = np.zeros((count, count, 3, 3)), np.zeros((count, count, 3))
    for j in range(count):
        for a in range(count):
            for m in range(3):
                for k in range(3):
                    t[j, a, m] += rotations[j, k, m] * (translations[a, k] - translations[j, k])
                    for n in range(3):
                        r[j, a, m, n] += rotations[j, k, m] * rotations[a, k, n]
    return r, t


@numba.njit(cache=True, nogil=True)
def _whitened(matrix, x, y):  # type: ignore[no-untyped-def]
    """Return matrix (2, 2) times (x, y)."""
    return matrix[0, 0] * x + matrix[0, 1] * y, matrix[1, 0] * x + matrix[1, 1] * y


@numba.njit(cache=True, nogil=True)
def _refine(  # type: ignore[no-untyped-def]
    relative_r, relative_t, use, anchor, anchor_ray, rho, prior, rays, seen, white, depth, depth_sigma, cauchy, limits, iterations
):
    """Minimise the cost of every landmark over its own ρ, poses fixed; writes ``rho`` and returns its information (L,)."""
    count, slots = len(seen), len(relative_r)
    information = np.zeros(count)
    for i in range(count):
        if not use[i]:
            continue
        a = anchor[i]
        for _ in range(iterations):
            h = 1.0 / prior[i, 1] ** 2
            g = (rho[i] - prior[i, 0]) * h
            z_a = 1.0 / rho[i]
            for j in range(slots):
                followed, measured = j != a and seen[i, j], depth_sigma[i, j] > 0
                if not (followed or measured):
                    continue
                r, t = relative_r[j, a], relative_t[j, a]
                d0 = (r[0, 0] * anchor_ray[i, 0] + r[0, 1] * anchor_ray[i, 1] + r[0, 2]) * z_a
                d1 = (r[1, 0] * anchor_ray[i, 0] + r[1, 1] * anchor_ray[i, 1] + r[1, 2]) * z_a
                d2 = (r[2, 0] * anchor_ray[i, 0] + r[2, 1] * anchor_ray[i, 1] + r[2, 2]) * z_a
                depth_j = d2 + t[2]
                if depth_j <= 1e-6:
                    continue
                z = 1.0 / depth_j
                if followed:
                    m = white[i, j]
                    u, v = (d0 + t[0]) * z, (d1 + t[1]) * z
                    e0, e1 = _whitened(m, u - rays[i, j, 0], v - rays[i, j, 1])
                    # d(d)/dρ = −d / ρ
                    j0, j1 = _whitened(m, -(d0 - u * d2) * z * z_a, -(d1 - v * d2) * z * z_a)
                    w = 1.0 / (1.0 + (e0 * e0 + e1 * e1) / (cauchy * cauchy))
                    h += w * (j0 * j0 + j1 * j1)
                    g += w * (j0 * e0 + j1 * e1)
                if measured:
                    s = 1.0 / depth_sigma[i, j]
                    e = (z - depth[i, j]) * s
                    jd = d2 * z * z * z_a * s
                    w = 1.0 / (1.0 + e * e / (cauchy * cauchy))
                    h += w * jd * jd
                    g += w * jd * e
            information[i] = h
            # A long step is one out of the quadratic's reach: ρ may only change by a third at a time.
            bound = rho[i] / 3.0
            step = min(max(-g / h, -bound), bound)
            rho[i] = min(max(rho[i] + step, limits[0]), limits[1])
            if abs(step) < 1e-7 * rho[i]:
                break
    return information


@numba.njit(cache=True, nogil=True)
def _add_row(hessian, gradient, coupling, row, e, w, jr, a, j):  # type: ignore[no-untyped-def]
    """Add one residual row: ``row`` holds its Jacobian on the anchor pose, then on the frame's pose; ``jr`` that on ρ."""
    for m in range(12):
        at_m = 6 * a + m if m < 6 else 6 * j + m - 6
        weighted = w * row[m]
        gradient[at_m] += weighted * e
        coupling[at_m] += weighted * jr
        for n in range(m, 12):
            at_n = 6 * a + n if n < 6 else 6 * j + n - 6
            # Only one triangle is filled; the caller mirrors it.
            if at_m <= at_n:
                hessian[at_m, at_n] += weighted * row[n]
            else:
                hessian[at_n, at_m] += weighted * row[n]


@numba.njit(cache=True, nogil=True)
def _condense(  # type: ignore[no-untyped-def]
    relative_r, relative_t, use, anchor, anchor_ray, rho, prior, rays, seen, white, depth, depth_sigma, cauchy, hessian, gradient
):
    count, slots = len(seen), len(relative_r)
    row, coupling = np.zeros(12), np.empty(6 * slots)
    cost = 0.0
    for i in range(count):
        if not use[i]:
            continue
        a = anchor[i]
        first, last = a, a
        coupling[:] = 0.0
        h = 1.0 / prior[i, 1] ** 2
        g = (rho[i] - prior[i, 0]) * h
        cost += g * (rho[i] - prior[i, 0])
        z_a = 1.0 / rho[i]
        p0, p1, p2 = anchor_ray[i, 0] * z_a, anchor_ray[i, 1] * z_a, z_a
        for j in range(slots):
            followed, measured = j != a and seen[i, j], depth_sigma[i, j] > 0
            if not (followed or measured):
                continue
            first, last = min(first, j), max(last, j)
            r, t = relative_r[j, a], relative_t[j, a]
            x0 = r[0, 0] * p0 + r[0, 1] * p1 + r[0, 2] * p2 + t[0]
            x1 = r[1, 0] * p0 + r[1, 1] * p1 + r[1, 2] * p2 + t[1]
            x2 = r[2, 0] * p0 + r[2, 1] * p1 + r[2, 2] * p2 + t[2]
            if x2 <= 1e-6:
                continue
            z = 1.0 / x2
            u, v = x0 * z, x1 * z
            for k in range(3):
                if (k < 2 and not followed) or (k == 2 and not measured):
                    continue
                if k < 2:
                    e0, e1 = _whitened(white[i, j], u - rays[i, j, 0], v - rays[i, j, 1])
                    squared, e = e0 * e0 + e1 * e1, e0 if k == 0 else e1
                    m0, m1 = white[i, j, k, 0], white[i, j, k, 1]
                    c0, c1, c2 = m0 * z, m1 * z, -(m0 * u + m1 * v) * z
                else:
                    s = 1.0 / depth_sigma[i, j]
                    e = (z - depth[i, j]) * s
                    squared = e * e
                    c0, c1, c2 = 0.0, 0.0, -z * z * s
                w = 1.0 / (1.0 + squared / (cauchy * cauchy))
                cost += cauchy * cauchy * np.log1p(squared / (cauchy * cauchy)) * (0.5 if k < 2 else 1.0)
                b0 = r[0, 0] * c0 + r[1, 0] * c1 + r[2, 0] * c2
                b1 = r[0, 1] * c0 + r[1, 1] * c1 + r[2, 1] * c2
                b2 = r[0, 2] * c0 + r[1, 2] * c1 + r[2, 2] * c2
                jr = -(b0 * p0 + b1 * p1 + b2 * p2) * z_a
                h += w * jr * jr
                g += w * jr * e
                if j == a:
                    # The anchor's own depth does not depend on any pose.
                    continue
                # d x_j / d[ω, v]_a = [−R_ja [p]×, R_ja]; d x_j / d[ω, v]_j = [[x]×, −I]
                row[0], row[1], row[2] = p1 * b2 - p2 * b1, p2 * b0 - p0 * b2, p0 * b1 - p1 * b0
                row[3], row[4], row[5] = b0, b1, b2
                row[6], row[7], row[8] = x2 * c1 - x1 * c2, x0 * c2 - x2 * c0, x1 * c0 - x0 * c1
                row[9], row[10], row[11] = -c0, -c1, -c2
                _add_row(hessian, gradient, coupling, row, e, w, jr, a, j)
        inverse = 1.0 / h
        for m in range(6 * first, 6 * last + 6):
            c = coupling[m] * inverse
            if c != 0.0:
                gradient[m] -= c * g
                for n in range(m, 6 * last + 6):
                    hessian[m, n] -= c * coupling[n]
    for m in range(6 * slots):
        for n in range(m + 1, 6 * slots):
            hessian[n, m] = hessian[m, n]
    return cost


@dataclass
class LandmarkArrays:
    """Views on the landmark table that the kernels read; L landmarks, K window slots.

    ``anchor`` (L,) int64; ``anchor_ray`` (L, 2); ``rho`` (L,) 1/m, written by :func:`refine`; ``prior`` (L, 2) mean and sigma of
    ρ; ``rays`` (L, K, 2); ``seen`` (L, K) where there is one; ``whitening`` (L, K, 2, 2) that turns an error of a ray into sigmas
    (:mod:`vli_backend.track_noise`); ``depth`` (L, K) measured 1/z in 1/m; ``depth_sigma`` (L, K), 0 where not measured.
    """

    anchor: AnyArray
    anchor_ray: FloatArray
    rho: FloatArray
    prior: FloatArray
    rays: FloatArray
    seen: BoolArray
    whitening: FloatArray
    depth: FloatArray
    depth_sigma: FloatArray

    def columns(self) -> tuple[AnyArray, ...]:
        """Return the arrays in the order in which the kernels take them."""
        return tuple(getattr(self, field.name) for field in fields(self))


def refine(
    landmarks: LandmarkArrays,
    T_map_camera: FloatArray,
    use: BoolArray,
    cauchy: float,
    limits: tuple[float, float],
    iterations: int = 5,
) -> FloatArray:
    """Solve every used landmark for its own inverse depth, poses (K, 4, 4) fixed; return the information of ρ (L,), m²."""
    information: FloatArray = _refine(*_pairs(T_map_camera), use, *landmarks.columns(), cauchy, limits, iterations)  # type: ignore[call-arg]
    return information


def condense(landmarks: LandmarkArrays, T_map_camera: FloatArray, use: BoolArray, cauchy: float) -> Quadratic:
    """Return eqs. (2) and (3) of the used landmarks as a quadratic in the K camera poses (K, 4, 4), depths eliminated."""
    size = 6 * len(T_map_camera)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    cost = _condense(*_pairs(T_map_camera), use, *landmarks.columns(), cauchy, hessian, gradient)  # type: ignore[call-arg]
    return Quadratic(hessian, gradient, float(cost))


def _pairs(T_map_camera: FloatArray) -> tuple[AnyArray, ...]:
    """Return R_ja (K, K, 3, 3) and t_ja (K, K, 3) between all pairs of poses (K, 4, 4)."""
    rotations, translations = np.ascontiguousarray(T_map_camera[:, :3, :3]), np.ascontiguousarray(T_map_camera[:, :3, 3])
    pairs: tuple[AnyArray, ...] = _relative_poses(rotations, translations)
    return pairs
