"""SE(3) and SO(3) on plain arrays.

A pose is a 4×4 float64 matrix ``T_a_b``; stacks are (N, 4, 4). Perturbations are right ones, ``T ← T Exp([ω, v])`` with
rotation first, as in GTSAM.
"""

from __future__ import annotations

import numba
import numpy as np

from vli_common.arrays import FloatArray

_SMALL = 1e-8


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
    omega = np.asarray(omega, dtype=np.float64)
    angle = np.linalg.norm(omega, axis=-1)[..., None, None]
    small = angle < _SMALL
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0, np.sin(safe) / safe)
    b = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    k = skew(omega)
    result: FloatArray = np.eye(3) + a * k + b * (k @ k)
    return result


def so3_log(rotation: FloatArray) -> FloatArray:
    """Return the rotation vectors (..., 3) of rotation matrices (..., 3, 3); angles in [0, π]."""
    q = quaternion_from_rotation(rotation)
    xyz, w = q[..., :3], q[..., 3]
    norm = np.linalg.norm(xyz, axis=-1)
    small = norm < _SMALL
    angle = 2.0 * np.arctan2(norm, w)
    scale = np.where(small, 2.0, angle / np.where(small, 1.0, norm))
    result: FloatArray = xyz * scale[..., None]
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
    rotation_t = np.swapaxes(T[..., :3, :3], -1, -2)
    return pose(rotation_t, -(rotation_t @ T[..., :3, 3:])[..., 0])


def transform(T: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (N, 3) of frame b in frame a; ``T`` is (4, 4), or (N, 4, 4) for one pose a point."""
    if T.ndim == 2:
        result: FloatArray = points @ T[:3, :3].T + T[:3, 3]
        return result
    result = np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
    return result


def orthonormalised(T: FloatArray) -> FloatArray:
    """Return a pose (4, 4) with its rotation brought back to SO(3); for poses that are chained, where rounding errors grow."""
    u, _, vt = np.linalg.svd(T[:3, :3])
    return pose(u @ vt, T[:3, 3])


def interpolate(T0: FloatArray, T1: FloatArray, alpha: FloatArray | float) -> FloatArray:
    """Return poses between (and slightly beyond) two: R₀ Exp(α Log(R₀ᵀR₁)), (1−α) t₀ + α t₁.

    Args:
        T0, T1: (4, 4), or stacks (N, 4, 4).
        alpha: scalar, or (N,) for a stack of results.

    The rotation between the two must be less than 180°, as between frames of one camera it always is.
    """
    alpha = np.asarray(alpha, dtype=np.float64)
    shape = np.broadcast_shapes(T0.shape[:-2], T1.shape[:-2], alpha.shape)
    stack = [np.broadcast_to(T, (*shape, 4, 4)).reshape(-1, 4, 4) for T in (T0, T1)]
    result: FloatArray = _interpolate(stack[0], stack[1], np.broadcast_to(alpha, shape).reshape(-1)).reshape(*shape, 4, 4)
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
    m = np.asarray(rotation, dtype=np.float64)
    d = np.stack([m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], axis=-1)
    trace = d.sum(axis=-1)
    # The largest of the four squared components is the safe one to divide by (Shepperd's method).
    squares = np.concatenate([1 + 2 * d - trace[..., None], (1 + trace)[..., None]], axis=-1)
    best = np.argmax(squares, axis=-1)
    x = np.stack(
        [squares[..., 0], m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] - m[..., 1, 2]], axis=-1
    )
    y = np.stack(
        [m[..., 0, 1] + m[..., 1, 0], squares[..., 1], m[..., 1, 2] + m[..., 2, 1], m[..., 0, 2] - m[..., 2, 0]], axis=-1
    )
    z = np.stack(
        [m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1], squares[..., 2], m[..., 1, 0] - m[..., 0, 1]], axis=-1
    )
    w = np.stack(
        [m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1], squares[..., 3]], axis=-1
    )
    q = np.take_along_axis(np.stack([x, y, z, w], axis=-2), best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    result: FloatArray = np.where(q[..., 3:] < 0, -q, q)
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
