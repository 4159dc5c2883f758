"""SO(3) for compiled kernels: one rotation at a time, where ``vli_common.geometry`` takes stacks from Python."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def skew(v):  # type: ignore[no-untyped-def]
    """Return [v]× (3, 3) of a vector (3,)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@numba.njit(cache=True, nogil=True)
def log(r):  # type: ignore[no-untyped-def]
    """Return the rotation vector (3,) of a rotation (3, 3) by less than 180°."""
    axis = 0.5 * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    sine = np.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
    angle = np.arctan2(sine, 0.5 * (r[0, 0] + r[1, 1] + r[2, 2] - 1.0))
    return axis * (angle / sine if sine > 1e-12 else 1.0)


@numba.njit(cache=True, nogil=True)
def right_jacobian(phi):  # type: ignore[no-untyped-def]
    """Return J_r (3, 3): Exp(φ + δ) ≈ Exp(φ) Exp(J_r δ)."""
    angle, k = np.sqrt((phi**2).sum()), skew(phi)
    if angle < 1e-6:
        return np.eye(3) - 0.5 * k
    return np.eye(3) - (1.0 - np.cos(angle)) / angle**2 * k + (angle - np.sin(angle)) / angle**3 * (k @ k)


@numba.njit(cache=True, nogil=True)
def inverse_right_jacobian(phi):  # type: ignore[no-untyped-def]
    """Return J_r⁻¹ (3, 3)."""
    angle, k = np.sqrt((phi**2).sum()), skew(phi)
    if angle < 1e-3:
        return np.eye(3) + 0.5 * k + k @ k / 12.0
    return np.eye(3) + 0.5 * k + (1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))) * (k @ k)


@numba.njit(cache=True, nogil=True)
def exp(phi):  # type: ignore[no-untyped-def]
    """Return the rotation (3, 3) of a rotation vector (3,), by Rodrigues' formula."""
    angle, k = np.sqrt((phi**2).sum()), skew(phi)
    if angle < 1e-9:
        return np.eye(3) + k
    return np.eye(3) + np.sin(angle) / angle * k + (1.0 - np.cos(angle)) / angle**2 * (k @ k)
