"""SE(3) and SO(3) on plain arrays.

A pose is a 4×4 float64 matrix ``T_a_b``; stacks are (N, 4, 4). Perturbations are right ones, ``T ← T Exp([ω, v])`` with
rotation first, as in GTSAM.
"""

from __future__ import annotations

import numba
import numpy as np

from vli_common.arrays import FloatArray

_SMALL = 1e-8


def _stack(matrices: FloatArray, size: int) -> FloatArray:
    """Return (..., size, size) as (N, size, size), as the kernels take it."""
    return np.ascontiguousarray(matrices, dtype=np.float64).reshape(-1, size, size)


def skew(v: FloatArray) -> FloatArray:
    """Return [v]× for (..., 3) as (..., 3, 3)."""
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def so3_exp(omega: FloatArray) -> FloatArray:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3), by Rodrigues' formula."""
    omega = np.ascontiguousarray(omega, dtype=np.float64)
    result: FloatArray = _exps(omega.reshape(-1, 3)).reshape(*omega.shape, 3)
    return result


def so3_log(rotation: FloatArray) -> FloatArray:
    """Return the rotation vectors (..., 3) of rotation matrices (..., 3, 3); angles in [0, π]."""
    result: FloatArray = _logs(_stack(rotation, 3)).reshape(*rotation.shape[:-2], 3)
    return result


def so3_right_jacobian(omega: FloatArray) -> FloatArray:
    """Return J_r (3, 3) of one rotation vector (3,): Exp(ω + δ) ≈ Exp(ω) Exp(J_r δ)."""
    angle = float(np.linalg.norm(omega))
    k = skew(omega)
    if angle < 1e-6:
        result: FloatArray = np.eye(3) - 0.5 * k
        return result
    result = np.eye(3) - (1 - np.cos(angle)) / angle**2 * k + (angle - np.sin(angle)) / angle**3 * (k @ k)
    return result


def pose(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    rotation = np.asarray(rotation, dtype=np.float64)
    translation = np.asarray(translation, dtype=np.float64)
    out = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1]), 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = rotation, translation, 1.0
    return out


def inverse(T: FloatArray) -> FloatArray:
    """Return T_b_a of T_a_b, for (..., 4, 4)."""
    result: FloatArray = _inverses(_stack(T, 4)).reshape(T.shape)
    return result


def transform(T: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (N, 3) of frame b in frame a; ``T`` is (4, 4), or (N, 4, 4) for one pose a point."""
    if T.ndim == 2:
        result: FloatArray = points @ T[:3, :3].T + T[:3, 3]
        return result
    result = np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
    return result


def orthonormalised(T: FloatArray) -> FloatArray:
    """Return a pose (4, 4) with its rotation brought back to SO(3); for poses that are chained, where rounding errors grow."""
    result: FloatArray = _orthonormalised(_stack(T, 4)[0])
    return result


def interpolate(T0: FloatArray, T1: FloatArray, alpha: FloatArray | float) -> FloatArray:
    """Return poses between (and slightly beyond) two: R₀ Exp(α Log(R₀ᵀR₁)), (1−α) t₀ + α t₁.

    Args:
        T0, T1: (4, 4), or stacks (N, 4, 4).
        alpha: scalar, or (N,) for a stack of results.

    The rotation between the two must be less than 180°, as between frames of one camera it always is.
    """
    alpha = np.asarray(alpha, dtype=np.float64)
    shape = np.broadcast_shapes(T0.shape[:-2], T1.shape[:-2], alpha.shape)
    # Copies: a kernel is compiled anew for what is strided or read-only.
    start, end = (np.array(np.broadcast_to(T, (*shape, 4, 4)), order="C").reshape(-1, 4, 4) for T in (T0, T1))
    result: FloatArray = _interpolate(start, end, np.broadcast_to(alpha, shape).flatten()).reshape(*shape, 4, 4)
    return result


@numba.njit(cache=True, nogil=True)
def _interpolate(start, end, alpha):  # type: ignore[no-untyped-def]
    """Interpolate between poses (N, 4, 4); in numba since every frame of the window passes here at every keyframe."""
    out = np.zeros((len(alpha), 4, 4))
    r = np.empty((3, 3))
    for i in range(len(alpha)):
        for m in range(3):
            for n in range(3):
                r[m, n] = 0.0
                for k in range(3):
                    r[m, n] += start[i, k, m] * end[i, k, n]
        # Half-angle form: exact for small angles, where acos of the trace is not.
        x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
        sine, cosine = 0.5 * np.sqrt(x * x + y * y + z * z), 0.5 * (r[0, 0] + r[1, 1] + r[2, 2] - 1.0)
        angle = np.arctan2(sine, cosine) * alpha[i]
        if sine > 1e-12:
            x, y, z = 0.5 * x / sine, 0.5 * y / sine, 0.5 * z / sine
        s, c = np.sin(angle), 1.0 - np.cos(angle)
        e = (
            (1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y),
            (c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x),
            (c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)),
        )
        for m in range(3):
            for n in range(3):
                out[i, m, n] = start[i, m, 0] * e[0][n] + start[i, m, 1] * e[1][n] + start[i, m, 2] * e[2][n]
            out[i, m, 3] = (1.0 - alpha[i]) * start[i, m, 3] + alpha[i] * end[i, m, 3]
        out[i, 3, 3] = 1.0
    return out


def quaternion_from_rotation(rotation: FloatArray) -> FloatArray:
    """Return unit quaternions (..., 4) in the order x y z w with w ≥ 0, of rotation matrices (..., 3, 3)."""
    result: FloatArray = _quaternions(_stack(rotation, 3)).reshape(*rotation.shape[:-2], 4)
    return result


def rotation_from_quaternion(q: FloatArray) -> FloatArray:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4) in the order x y z w (normalised here)."""
    q = np.asarray(q, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    v, w = q[..., :3], q[..., 3]
    k = skew(v)
    result: FloatArray = np.eye(3) + 2 * (w[..., None, None] * k + k @ k)
    return result


def rotation_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the smallest rotation (3, 3) that turns direction a (3,) into direction b (3,)."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis, cosine = np.cross(a, b), float(a @ b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        axis = np.cross(a, [1.0, 0, 0] if abs(a[0]) < 0.9 else [0, 1.0, 0])
        return so3_exp(np.pi * axis / np.linalg.norm(axis))
    return so3_exp(axis / sine * np.arctan2(sine, cosine))


def align(source: FloatArray, target: FloatArray, with_scale: bool = False) -> tuple[FloatArray, float]:
    """Return (T, s) that minimise Σ |target − (s R source + t)|² (Umeyama, 1991); s is 1 without scale.

    Args:
        source, target: (N, 3), N ≥ 3 and not on one line for a unique rotation.
    """
    mean_s, mean_t = source.mean(axis=0), target.mean(axis=0)
    centred_s, centred_t = source - mean_s, target - mean_t
    u, singular, vt = np.linalg.svd(centred_t.T @ centred_s / len(source))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt)) or 1.0])
    rotation = (u * sign) @ vt
    variance = float((centred_s**2).sum() / len(source))
    scale = float(singular @ sign) / variance if with_scale and variance > 0 else 1.0
    return pose(rotation, mean_t - scale * rotation @ mean_s), scale


# One pose costs numpy a dozen small calls, and every frame asks for some; hence kernels.


@numba.njit(cache=True, nogil=True)
def _quaternions(m):  # type: ignore[no-untyped-def]
    """Shepperd's method: the largest of the four squared components is the safe one to divide by."""
    out = np.empty((len(m), 4))
    for i in range(len(m)):
        r = m[i]
        trace = r[0, 0] + r[1, 1] + r[2, 2]
        best, value = 3, 1.0 + trace
        for k in range(3):
            if 1.0 + 2.0 * r[k, k] - trace > value:
                best, value = k, 1.0 + 2.0 * r[k, k] - trace
        q = out[i]
        if best == 3:
            q[0], q[1], q[2], q[3] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], value
        else:
            a, b = (best + 1) % 3, (best + 2) % 3
            q[best], q[a], q[b], q[3] = value, r[a, best] + r[best, a], r[b, best] + r[best, b], r[b, a] - r[a, b]
        norm = np.sqrt((q**2).sum())
        if q[3] < 0.0:
            norm = -norm
        q /= norm
    return out


@numba.njit(cache=True, nogil=True)
def _logs(m):  # type: ignore[no-untyped-def]
    q = _quaternions(m)
    out = np.empty((len(m), 3))
    for i in range(len(m)):
        norm = np.sqrt(q[i, 0] ** 2 + q[i, 1] ** 2 + q[i, 2] ** 2)
        scale = 2.0 if norm < _SMALL else 2.0 * np.arctan2(norm, q[i, 3]) / norm
        out[i] = q[i, :3] * scale
    return out


@numba.njit(cache=True, nogil=True)
def _inverses(T):  # type: ignore[no-untyped-def]
    out = np.zeros(T.shape)
    for i in range(len(T)):
        for m in range(3):
            for n in range(3):
                out[i, m, n] = T[i, n, m]
                out[i, m, 3] -= T[i, n, m] * T[i, n, 3]
        out[i, 3, 3] = 1.0
    return out


@numba.njit(cache=True, nogil=True)
def _exps(omega):  # type: ignore[no-untyped-def]
    out = np.empty((len(omega), 3, 3))
    for i in range(len(omega)):
        x, y, z = omega[i]
        angle = np.sqrt(x * x + y * y + z * z)
        a, b = 1.0, 0.5
        if angle >= _SMALL:
            # 1 − cos as 2 sin²(θ/2), which does not cancel.
            a, b = np.sin(angle) / angle, 2.0 * (np.sin(0.5 * angle) / angle) ** 2
        out[i, 0] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
        out[i, 1] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
        out[i, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    return out


@numba.njit(cache=True, nogil=True)
def _orthonormalised(T):  # type: ignore[no-untyped-def]
    """Newton's iteration to the polar factor; it doubles the digits, and chained poses have lost but the last few."""
    out = T.copy()
    r = np.ascontiguousarray(out[:3, :3])
    for _ in range(3):
        r = r @ (1.5 * np.eye(3) - 0.5 * (r.T @ r))
    out[:3, :3] = r
    return out
