"""Alignment of each track to the patch seen at its birth: affine warp, gain, bias and a gain that slopes across the patch.

Inverse-compositional (Baker and Matthews, 2004). The image under the warp is modelled as

    I(W(x)) = g T(Δ(x)) + b + (s_u u + s_v v) T(x),   Δ(x) = x + t + M (u, v)

with u, v the offsets over the half width, which is linear in (g t, g M, g, b, s): the rows gx, gy, gx·u, gx·v, gy·u, gy·v,
T − mean(T), 1, u·T, v·T, their weighted normal matrix and its inverse are fixed at birth. Without the slope of the gain an
on-board light leaves twice the drift.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from vli_common.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray

RADIUS = 10
"""Of a patch, pixels."""
MARGIN_PX = RADIUS + 2
"""A patch needs this distance from the image border (one pixel more than it covers, for the gradient)."""
_UNKNOWNS = 10
_WEIGHT_SIGMA_PX = 5.0
_CONVERGED_PX = 0.01
_ITERATIONS = 10
_NOISE_CORRELATION = 3.0
"""Error over the bound for white noise: demosaicing, low pass and interpolation correlate it between pixels; measured."""
_DEFORMATION_PX = 0.08
"""Where what is left is more than noise it is structure, which pulls harder: measured, see test/perf/bench_klt.py."""
_EXPECTED_RESIDUAL = 1.1
"""Grey levels left of a patch in the frame after its birth."""

_DY, _DX = np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1]
# The corners of the square weigh less than 0.13; leaving them out saves a quarter of the time.
_INSIDE = _DX**2 + _DY**2 <= (RADIUS + 0.25) ** 2
_X, _Y = _DX[_INSIDE].astype(np.float32), _DY[_INSIDE].astype(np.float32)
_U, _V = _X / np.float32(RADIUS), _Y / np.float32(RADIUS)
_WEIGHT = np.exp(-0.5 * (_X**2 + _Y**2) / _WEIGHT_SIGMA_PX**2).astype(np.float32)
_PIXELS = len(_X)


@dataclass(frozen=True, slots=True)
class Aligned:
    """Where the patches were found.

    Args:
        pixels: (N, 2), the start where not converged.
        affine: (N, 2, 2), patch at birth → image.
        converged: (N,).
        correlation: (N,), weighted, of the patch with the one at birth under the fitted light.
        sigma: (N,) standard deviation of ``pixels`` per axis, ``inf`` where not converged.
    """

    pixels: FloatArray
    affine: FloatArray
    converged: BoolArray
    correlation: FloatArray
    sigma: FloatArray


class PatchTemplates:
    """The patches seen at birth, in numbered slots.

    Args:
        capacity: number of slots.
    """

    def __init__(self, capacity: int) -> None:
        self._solvers = np.zeros((capacity, _UNKNOWNS, _PIXELS), np.float32)
        self._patches = np.zeros((capacity, _PIXELS), np.float32)
        self.valid = np.zeros(capacity, np.bool_)
        """(capacity,): False where the texture determines no position."""
        self.sigma_per_level = np.full(capacity, np.inf)
        """(capacity,): of the position per axis, pixels for one grey level of white noise (Cramér–Rao bound)."""

    def create(self, grey: ByteArray, slots: IntArray, pixels: FloatArray) -> None:
        """Take new patches around ``pixels`` (N, 2) into ``slots`` (N,); all at least :data:`MARGIN_PX` inside the image."""
        _create(grey, slots, pixels, self._solvers, self._patches, self.valid, self.sigma_per_level)

    def align(self, grey: ByteArray, slots: IntArray, start: FloatArray, affine: FloatArray) -> Aligned:
        """Find the patches of ``slots`` (N,) from positions (N, 2) and affine warps (N, 2, 2)."""
        pixels, warps = start.copy(), affine.copy()
        converged = np.zeros(len(slots), np.bool_)
        correlation, residual = np.zeros(len(slots)), np.full(len(slots), np.inf)
        _align(grey, slots, self._solvers, self._patches, self.valid, pixels, warps, converged, correlation, residual)
        return Aligned(pixels, warps, converged, correlation, self._sigma(slots, residual))

    def initial_sigma(self, slots: IntArray) -> FloatArray:
        """Return the standard deviation (N,) to expect of the first alignment, pixels per axis."""
        return self._sigma(slots, np.full(len(slots), _EXPECTED_RESIDUAL))

    def _sigma(self, slots: IntArray, residual: FloatArray) -> FloatArray:
        """Return pixels (N,) from what is left of each patch (N,), grey levels: the a-posteriori error of the fit.

        What is left is noise at first; it grows as the view changes, and across a depth edge, where nothing else tells that the
        position is wrong.
        """
        sigma = residual * self.sigma_per_level[slots]
        result: FloatArray = _NOISE_CORRELATION * sigma * (1.0 + (sigma / _DEFORMATION_PX) ** 2)
        return result


# Kernels with fast mathematics that others call are inlined by force. Else LLVM keeps two versions, one vectorised in its caller,
# which round differently; which of them runs depends on whether it was compiled in this process or comes from the cache.


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy", forceinline=True)
def _sample(grey: ByteArray, x: float, y: float, warp: FloatArray, out: Float32Array) -> None:
    """Write the bilinear values (_PIXELS,) of the image under the warp; beyond the border its edge is repeated."""
    height, width = grey.shape
    limit_x, limit_y = np.float32(width - 1.001), np.float32(height - 1.001)
    centre_x, centre_y = np.float32(x), np.float32(y)
    a, b, c, d = np.float32(warp[0, 0]), np.float32(warp[0, 1]), np.float32(warp[1, 0]), np.float32(warp[1, 1])
    zero, next_one = np.float32(0.0), np.uint32(1)
    for k in range(_PIXELS):
        px = min(max(centre_x + a * _X[k] + b * _Y[k], zero), limit_x)
        py = min(max(centre_y + c * _X[k] + d * _Y[k], zero), limit_y)
        # Unsigned indices spare the test for negative ones, which would keep the loop from being vectorised.
        ix, iy = np.uint32(np.int32(px)), np.uint32(np.int32(py))
        fx, fy = px - np.float32(ix), py - np.float32(iy)
        left, right = np.float32(grey[iy, ix]), np.float32(grey[iy, ix + next_one])
        lower_left, lower_right = np.float32(grey[iy + next_one, ix]), np.float32(grey[iy + next_one, ix + next_one])
        top, bottom = left + fx * (right - left), lower_left + fx * (lower_right - lower_left)
        out[k] = top + fy * (bottom - top)


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def _sample_square(grey: ByteArray, x: float, y: float, out: Float32Array) -> None:
    """Write the bilinear values of an upright square centred on a point, all inside the image."""
    size = len(out)
    ix, iy = int(x) - size // 2, int(y) - size // 2
    fx, fy = np.float32(x - int(x)), np.float32(y - int(y))
    one = np.float32(1.0)
    for j in range(size):
        upper, lower = grey[iy + j, ix : ix + size + 1], grey[iy + j + 1, ix : ix + size + 1]
        for i in range(size):
            top = (one - fx) * np.float32(upper[i]) + fx * np.float32(upper[i + 1])
            bottom = (one - fx) * np.float32(lower[i]) + fx * np.float32(lower[i + 1])
            out[j, i] = (one - fy) * top + fy * bottom


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def _fill_rows(square: Float32Array, patch: Float32Array, rows: Float32Array) -> None:
    """Write the patch (_PIXELS,) and the rows (_UNKNOWNS, _PIXELS) of the linear model from its square with a rim of one."""
    half, total = np.float32(0.5), np.float32(0.0)
    for k in range(_PIXELS):
        i, j = int(_X[k]) + RADIUS + 1, int(_Y[k]) + RADIUS + 1
        patch[k] = square[j, i]
        rows[0, k] = half * (square[j, i + 1] - square[j, i - 1])
        rows[1, k] = half * (square[j + 1, i] - square[j - 1, i])
        total += patch[k]
    mean = total / np.float32(_PIXELS)
    for k in range(_PIXELS):
        rows[2, k], rows[3, k] = rows[0, k] * _U[k], rows[0, k] * _V[k]
        rows[4, k], rows[5, k] = rows[1, k] * _U[k], rows[1, k] * _V[k]
        rows[6, k], rows[7, k] = patch[k] - mean, np.float32(1.0)
        rows[8, k], rows[9, k] = _U[k] * patch[k], _V[k] * patch[k]


@njit(cache=True, nogil=True)
def _invert(matrix: FloatArray) -> bool:
    """Invert a symmetric positive definite matrix in place (Gauss–Jordan); False where it is not one, to rounding."""
    n = len(matrix)
    scale = np.empty(n)
    for i in range(n):
        if matrix[i, i] <= 0.0:
            return False
        scale[i] = 1.0 / math.sqrt(matrix[i, i])
    for i in range(n):
        for j in range(n):
            matrix[i, j] *= scale[i] * scale[j]
    for i in range(n):
        pivot = matrix[i, i]
        if pivot < 1e-6:
            return False
        matrix[i, i] = 1.0
        for j in range(n):
            matrix[i, j] /= pivot
        for k in range(n):
            if k != i:
                factor = matrix[k, i]
                matrix[k, i] = 0.0
                for j in range(n):
                    matrix[k, j] -= factor * matrix[i, j]
    for i in range(n):
        for j in range(n):
            matrix[i, j] *= scale[i] * scale[j]
    return True


@njit(cache=True, nogil=True, fastmath=True)
def _create(
    grey: ByteArray,
    slots: IntArray,
    pixels: FloatArray,
    solvers: Float32Array,
    patches: Float32Array,
    valid: BoolArray,
    sigma: FloatArray,
) -> None:
    square = np.empty((2 * RADIUS + 3, 2 * RADIUS + 3), np.float32)
    rows = np.empty((_UNKNOWNS, _PIXELS), np.float32)
    normal = np.empty((_UNKNOWNS, _UNKNOWNS))
    for n in range(len(slots)):
        slot = slots[n]
        _sample_square(grey, pixels[n, 0], pixels[n, 1], square)
        _fill_rows(square, patches[slot], rows)
        for i in range(_UNKNOWNS):
            for j in range(i + 1):
                total = np.float32(0.0)
                for k in range(_PIXELS):
                    total += rows[i, k] * rows[j, k] * _WEIGHT[k]
                normal[i, j] = normal[j, i] = total
        valid[slot] = _invert(normal)
        sigma[slot] = np.inf
        if valid[slot]:
            _fill_solver(rows, normal, solvers[slot])
            sigma[slot] = math.sqrt(0.5 * ((solvers[slot, :2] ** 2).sum()))


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def _fill_solver(rows: Float32Array, inverse: FloatArray, solver: Float32Array) -> None:
    """Write (JᵀWJ)⁻¹ JᵀW, (_UNKNOWNS, _PIXELS)."""
    for i in range(_UNKNOWNS):
        solver[i] = 0.0
        for j in range(_UNKNOWNS):
            factor = np.float32(inverse[i, j])
            for k in range(_PIXELS):
                solver[i, k] += factor * rows[j, k]
        for k in range(_PIXELS):
            solver[i, k] *= _WEIGHT[k]


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def _solve(solver: Float32Array, values: Float32Array, unknowns: FloatArray) -> None:
    for i in range(_UNKNOWNS):
        total = np.float32(0.0)
        for k in range(_PIXELS):
            total += solver[i, k] * values[k]
        unknowns[i] = total


@njit(cache=True, nogil=True)
def _compose(pixel: FloatArray, warp: FloatArray, unknowns: FloatArray) -> float:
    """Compose the warp with the inverse of the increment, W ← W ∘ Δ⁻¹; return the step of the centre in pixels."""
    gain = unknowns[6]
    tx, ty = unknowns[0] / gain, unknowns[1] / gain
    a, b = 1.0 + unknowns[2] / gain / RADIUS, unknowns[3] / gain / RADIUS
    c, d = unknowns[4] / gain / RADIUS, 1.0 + unknowns[5] / gain / RADIUS
    det = a * d - b * c
    if abs(det) < 0.1:
        return np.inf
    for i in range(2):
        left, right = (warp[i, 0] * d - warp[i, 1] * c) / det, (warp[i, 1] * a - warp[i, 0] * b) / det
        warp[i, 0], warp[i, 1] = left, right
        pixel[i] -= left * tx + right * ty
    return math.hypot(tx, ty)


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def _agreement(patch: Float32Array, values: Float32Array, unknowns: FloatArray) -> tuple[float, float]:
    """Return the weighted correlation of the values with the patch under the fitted light, and the RMS of what differs."""
    mean = 0.0
    for k in range(_PIXELS):
        mean += patch[k] / _PIXELS
    weights, sum_m, sum_v, sum_mm, sum_vv, sum_mv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(_PIXELS):
        model = unknowns[6] * (patch[k] - mean) + (unknowns[8] * _U[k] + unknowns[9] * _V[k]) * patch[k]
        value, weight = values[k], _WEIGHT[k]
        weights += weight
        sum_m += weight * model
        sum_v += weight * value
        sum_mm += weight * model * model
        sum_vv += weight * value * value
        sum_mv += weight * model * value
    product = (sum_mm * weights - sum_m * sum_m) * (sum_vv * weights - sum_v * sum_v)
    if product <= 0.0:
        return 0.0, np.inf
    correlation = (sum_mv * weights - sum_m * sum_v) / math.sqrt(product)
    variance = (sum_vv * weights - sum_v * sum_v) / (weights * weights)
    return correlation, math.sqrt(variance * max(0.0, 1.0 - correlation * correlation))


@njit(cache=True, nogil=True)
def _align(
    grey: ByteArray,
    slots: IntArray,
    solvers: Float32Array,
    patches: Float32Array,
    valid: BoolArray,
    pixels: FloatArray,
    warps: FloatArray,
    converged: BoolArray,
    correlation: FloatArray,
    residual: FloatArray,
) -> None:
    values, unknowns = np.empty(_PIXELS, np.float32), np.empty(_UNKNOWNS)
    for n in range(len(slots)):
        slot = slots[n]
        if not valid[slot]:
            continue
        start_x, start_y = pixels[n, 0], pixels[n, 1]
        for _ in range(_ITERATIONS):
            _sample(grey, pixels[n, 0], pixels[n, 1], warps[n], values)
            _solve(solvers[slot], values, unknowns)
            # A gain near zero or negative is another patch; so is one that ran away.
            if not 0.1 < unknowns[6] < 10.0:
                break
            step = _compose(pixels[n], warps[n], unknowns)
            if not math.hypot(pixels[n, 0] - start_x, pixels[n, 1] - start_y) < RADIUS:
                break
            if step < _CONVERGED_PX:
                converged[n] = True
                correlation[n], residual[n] = _agreement(patches[slot], values, unknowns)
                break
        if not converged[n]:
            pixels[n, 0], pixels[n, 1] = start_x, start_y
