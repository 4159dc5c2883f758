"""Residuals (2) and (3) of the window, condensed to its poses.

Each landmark is an inverse depth ρ along the ray of its anchor keyframe. Its reprojections into the other keyframes, eq. (3),
and its laser depth in the primary frame, eq. (2), depend on two poses and ρ; ρ is eliminated by a Schur complement, so that a
landmark leaves only a quadratic in the poses. Elimination happens at the optimal ρ, which makes it a variable projection: the
poses converge as if depths were solved with them.

Tangent vectors are ``[ω, v]`` of right perturbations of the camera poses ``T_map_camera``. All residuals are in units of their
standard deviation, with Cauchy weights.
"""

from __future__ import annotations

from dataclasses import dataclass

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
        count = len(self.gradient) // 6
        blocks = self.hessian.reshape(count, 6, count, 6)
        hessian = np.einsum("ai,kalb,bj->kilj", adjoint, blocks, adjoint, optimize=True).reshape(6 * count, 6 * count)
        gradient = (self.gradient.reshape(count, 6) @ adjoint).reshape(-1)
        return Quadratic(hessian, gradient, self.constant)


@numba.njit(cache=True)
def _residual(anchor_r, anchor_t, ray, rho, r, t, out):  # type: ignore[no-untyped-def]
    """Write the landmark in frame (r, t) to ``out``; return the rotation from the anchor into that frame."""
    relative = r.T @ anchor_r
    p = np.array([ray[0] / rho, ray[1] / rho, 1.0 / rho])
    out[:] = relative @ p + r.T @ (anchor_t - t)
    return relative


@numba.njit(cache=True)
def refine_depths(  # type: ignore[no-untyped-def]
    rotations, translations, use, anchor, anchor_ray, rho, prior, rays, sigma, depth, depth_sigma, cauchy, limits, iterations
):
    """Minimise the cost of every landmark over its own ρ, poses fixed; writes ``rho`` and returns its information (L,)."""
    count, slots = sigma.shape
    information = np.zeros(count)
    x = np.empty(3)
    for i in range(count):
        if not use[i]:
            continue
        a = anchor[i]
        damping = 0.0
        for _ in range(iterations):
            h = 1.0 / prior[i, 1] ** 2
            g = (rho[i] - prior[i, 0]) * h
            p = np.array([anchor_ray[i, 0] / rho[i], anchor_ray[i, 1] / rho[i], 1.0 / rho[i]])
            for j in range(slots):
                if j != a and sigma[i, j] > 0:
                    relative = _residual(rotations[a], translations[a], anchor_ray[i], rho[i], rotations[j], translations[j], x)
                    d = -(relative @ p) / rho[i]
                    if x[2] <= 1e-6:
                        continue
                    z = 1.0 / x[2]
                    e0 = (x[0] * z - rays[i, j, 0]) / sigma[i, j]
                    e1 = (x[1] * z - rays[i, j, 1]) / sigma[i, j]
                    j0 = (d[0] - x[0] * z * d[2]) * z / sigma[i, j]
                    j1 = (d[1] - x[1] * z * d[2]) * z / sigma[i, j]
                    w = 1.0 / (1.0 + (e0 * e0 + e1 * e1) / cauchy**2)
                    h += w * (j0 * j0 + j1 * j1)
                    g += w * (j0 * e0 + j1 * e1)
                if depth_sigma[i, j] > 0:
                    relative = _residual(rotations[a], translations[a], anchor_ray[i], rho[i], rotations[j], translations[j], x)
                    d = -(relative @ p) / rho[i]
                    if x[2] <= 1e-6:
                        continue
                    e = (1.0 / x[2] - depth[i, j]) / depth_sigma[i, j]
                    jd = -d[2] / (x[2] * x[2]) / depth_sigma[i, j]
                    w = 1.0 / (1.0 + e * e / cauchy**2)
                    h += w * jd * jd
                    g += w * jd * e
            information[i] = h
            step = -g / (h * (1.0 + damping))
            # A long step is one out of the quadratic's reach: ρ is only allowed to change by a third at a time.
            bound = rho[i] / 3.0
            step = min(max(step, -bound), bound)
            rho[i] = min(max(rho[i] + step, limits[0]), limits[1])
            if abs(step) < 1e-6 * rho[i]:
                break
    return information


@numba.njit(cache=True)
def _accumulate_pair(hessian, gradient, coupling, ja, jj, a, j, e, jr, w):  # type: ignore[no-untyped-def]
    """Add one residual row with Jacobians on anchor pose, frame pose and ρ."""
    for m in range(6):
        wa, wj = w * ja[m], w * jj[m]
        gradient[6 * a + m] += wa * e
        gradient[6 * j + m] += wj * e
        coupling[6 * a + m] += wa * jr
        coupling[6 * j + m] += wj * jr
        for n in range(6):
            hessian[6 * a + m, 6 * a + n] += wa * ja[n]
            hessian[6 * j + m, 6 * j + n] += wj * jj[n]
            hessian[6 * a + m, 6 * j + n] += wa * jj[n]
            hessian[6 * j + m, 6 * a + n] += wj * ja[n]


@numba.njit(cache=True)
def _condense(  # type: ignore[no-untyped-def]
    rotations, translations, use, anchor, anchor_ray, rho, prior, rays, sigma, depth, depth_sigma, cauchy, hessian, gradient
):
    count, slots = sigma.shape
    x, ja, jj, row = np.empty(3), np.empty(6), np.empty(6), np.empty(3)
    cost = 0.0
    for i in range(count):
        if not use[i]:
            continue
        a = anchor[i]
        first, last = a, a
        coupling = np.zeros(6 * slots)
        h = 1.0 / prior[i, 1] ** 2
        g = (rho[i] - prior[i, 0]) * h
        cost += g * (rho[i] - prior[i, 0])
        p = np.array([anchor_ray[i, 0] / rho[i], anchor_ray[i, 1] / rho[i], 1.0 / rho[i]])
        for j in range(slots):
            seen, measured = j != a and sigma[i, j] > 0, depth_sigma[i, j] > 0
            if not (seen or measured):
                continue
            first, last = min(first, j), max(last, j)
            relative = _residual(rotations[a], translations[a], anchor_ray[i], rho[i], rotations[j], translations[j], x)
            if x[2] <= 1e-6:
                continue
            z = 1.0 / x[2]
            for k in range(3):
                if k < 2 and not seen or k == 2 and not measured:
                    continue
                if k < 2:
                    s = 1.0 / sigma[i, j]
                    e = (x[k] * z - rays[i, j, k]) * s
                    row[:] = 0.0
                    row[k] = z * s
                    row[2] = -x[k] * z * z * s
                    e0 = (x[0] * z - rays[i, j, 0]) * s
                    e1 = (x[1] * z - rays[i, j, 1]) * s
                    squared = e0 * e0 + e1 * e1
                else:
                    s = 1.0 / depth_sigma[i, j]
                    e = (z - depth[i, j]) * s
                    row[:] = 0.0
                    row[2] = -z * z * s
                    squared = e * e
                w = 1.0 / (1.0 + squared / cauchy**2)
                b = relative.T @ row
                # d x_j / d ω_a = −R_ja [p]×, d/d v_a = R_ja; d x_j / d ω_j = [x]×, d/d v_j = −I
                ja[0], ja[1], ja[2] = p[1] * b[2] - p[2] * b[1], p[2] * b[0] - p[0] * b[2], p[0] * b[1] - p[1] * b[0]
                ja[3:] = b
                jj[0], jj[1], jj[2] = x[2] * row[1] - x[1] * row[2], x[0] * row[2] - x[2] * row[0], x[1] * row[0] - x[0] * row[1]
                jj[3:] = -row
                jr = -(b[0] * p[0] + b[1] * p[1] + b[2] * p[2]) / rho[i]
                if j == a:
                    # The anchor's own depth does not depend on any pose.
                    ja[:] = 0.0
                    jj[:] = 0.0
                _accumulate_pair(hessian, gradient, coupling, ja, jj, a, j, e, jr, w)
                h += w * jr * jr
                g += w * jr * e
                cost += cauchy**2 * np.log1p(squared / cauchy**2) * (0.5 if k < 2 else 1.0)
        for m in range(6 * first, 6 * last + 6):
            if coupling[m] == 0.0:
                continue
            c = coupling[m] / h
            gradient[m] -= c * g
            for n in range(6 * first, 6 * last + 6):
                hessian[m, n] -= c * coupling[n]
    return cost


@dataclass
class LandmarkArrays:
    """Views on the landmark table that the kernels read; L landmarks, K window slots.

    ``anchor`` (L,) int64; ``anchor_ray`` (L, 2); ``rho`` (L,) 1/m, written by :func:`refine`; ``prior`` (L, 2) mean and sigma of ρ;
    ``rays`` (L, K, 2); ``sigma`` (L, K) of the rays, 0 where not observed; ``depth`` (L, K) measured 1/z in 1/m; ``depth_sigma``
    (L, K), 0 where not measured.
    """

    anchor: AnyArray
    anchor_ray: FloatArray
    rho: FloatArray
    prior: FloatArray
    rays: FloatArray
    sigma: FloatArray
    depth: FloatArray
    depth_sigma: FloatArray


def refine(
    landmarks: LandmarkArrays, T_map_camera: FloatArray, use: BoolArray, cauchy: float, limits: tuple[float, float], iterations: int = 5
) -> FloatArray:
    """Solve every used landmark for its own inverse depth, poses (K, 4, 4) fixed; return the information of ρ (L,), m²."""
    rotations, translations = np.ascontiguousarray(T_map_camera[:, :3, :3]), np.ascontiguousarray(T_map_camera[:, :3, 3])
    k = len(rotations)
    m = landmarks
    information: FloatArray = refine_depths(
        rotations, translations, use, m.anchor, m.anchor_ray, m.rho, m.prior, m.rays[:, :k], m.sigma[:, :k], m.depth[:, :k],
        m.depth_sigma[:, :k], cauchy, limits, iterations,
    )  # fmt: skip
    return information


def condense(landmarks: LandmarkArrays, T_map_camera: FloatArray, use: BoolArray, cauchy: float) -> Quadratic:
    """Return eqs. (2) and (3) of the used landmarks as a quadratic in the K camera poses (K, 4, 4), depths eliminated."""
    rotations, translations = np.ascontiguousarray(T_map_camera[:, :3, :3]), np.ascontiguousarray(T_map_camera[:, :3, 3])
    k = len(rotations)
    hessian, gradient = np.zeros((6 * k, 6 * k)), np.zeros(6 * k)
    m = landmarks
    cost = _condense(
        rotations, translations, use, m.anchor, m.anchor_ray, m.rho, m.prior, m.rays[:, :k], m.sigma[:, :k], m.depth[:, :k],
        m.depth_sigma[:, :k], cauchy, hessian, gradient,
    )  # fmt: skip
    return Quadratic(hessian, gradient, float(cost))
