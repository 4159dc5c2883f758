"""Procedural solid textures, evaluated at the points that rays hit.

Every octave of noise fades out before its cells become smaller than the pixel's footprint on the surface, so that the images
are band-limited and do not shimmer: texture detail reaches 0.1 mm, and a pixel sees its mean.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from scipy.ndimage import gaussian_filter

from vli_common.arrays import ByteArray, Float32Array, FloatArray

FAST = {"contract", "arcp", "nsz"}
"""Fused multiply-add and the like: a last bit of brightness is no matter here, NaN and infinity keep their meaning."""
_SIZE = 64
_MASK = _SIZE - 1
# The noise lattice is turned from octave to octave: else its axes would show.
_TURN = ((0.36, 0.48, -0.80), (-0.80, 0.60, 0.0), (0.48, 0.64, 0.60))
_LACUNARITY = 0.29


def noise_table(seed: int) -> Float32Array:
    """Return the periodic lattice (64³,) of zero mean and unit variance; it holds two octaves, so that one look-up gives both."""
    rng = np.random.default_rng([seed, 4])
    coarse = gaussian_filter(rng.standard_normal((_SIZE,) * 3), 1.1, mode="wrap")
    fine = rng.uniform(-np.sqrt(3), np.sqrt(3), (_SIZE,) * 3)
    table = 0.8 * coarse / coarse.std() + 0.6 * fine
    return np.ascontiguousarray(table.ravel(), dtype=np.float32)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def value_noise(table: Float32Array, x: float, y: float, z: float) -> float:
    """Interpolate the lattice at (x, y, z), in cells, with a quintic fade."""
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    u, v, w = x - fx, y - fy, z - fz
    i, j, k = np.int64(fx) & _MASK, np.int64(fy) & _MASK, np.int64(fz) & _MASK
    i1, j1, k1 = ((i + 1) & _MASK) << 12, ((j + 1) & _MASK) << 6, (k + 1) & _MASK
    i, j = i << 12, j << 6
    u = u * u * u * (u * (u * 6 - 15) + 10)
    v = v * v * v * (v * (v * 6 - 15) + 10)
    w = w * w * w * (w * (w * 6 - 15) + 10)
    a = table[i | j | k] + w * (table[i | j | k1] - table[i | j | k])
    b = table[i | j1 | k] + w * (table[i | j1 | k1] - table[i | j1 | k])
    c = table[i1 | j | k] + w * (table[i1 | j | k1] - table[i1 | j | k])
    d = table[i1 | j1 | k] + w * (table[i1 | j1 | k1] - table[i1 | j1 | k])
    e = a + v * (b - a)
    f = c + v * (d - c)
    return float(e + u * (f - e))


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def fractal_noise(
    table: Float32Array, x: float, y: float, z: float, cell: float, octaves: int, persistence: float, footprint: float
) -> float:
    """Sum ``octaves`` look-ups at (x, y, z) metres, the first with cells of ``cell`` metres; fades cells near the footprint."""
    total = 0.0
    amplitude = 1.0
    for octave in range(octaves):
        fade = cell / footprint - 1.0
        if fade <= 0.0:
            break
        total += min(fade, 1.0) * amplitude * value_noise(table, x / cell + 17.31 * octave, y / cell + 5.77, z / cell)
        x, y, z = (
            _TURN[0][0] * x + _TURN[0][1] * y + _TURN[0][2] * z,
            _TURN[1][0] * x + _TURN[1][1] * y + _TURN[1][2] * z,
            _TURN[2][0] * x + _TURN[2][1] * y + _TURN[2][2] * z,
        )
        cell *= _LACUNARITY
        amplitude *= persistence
    return total


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _hash(i: int | np.integer[Any], j: int | np.integer[Any], k: int | np.integer[Any]) -> np.uint32:
    h = np.uint32(i) * np.uint32(374761393) + np.uint32(j) * np.uint32(668265263) + np.uint32(k) * np.uint32(2246822519)
    h = (h ^ (h >> np.uint32(13))) * np.uint32(1274126177)
    return h ^ (h >> np.uint32(16))


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def speck(x: float, y: float, z: float, cell: float, density: float, footprint: float) -> float:
    """Return the coverage by a grain of dirt, −1 (dark) to 1 (bright): at most one round grain in a cell of ``cell`` metres."""
    x, y, z = x / cell, y / cell, z / cell
    i, j, k = np.floor(x), np.floor(y), np.floor(z)
    h = _hash(np.int64(i) & 0xFFFF, np.int64(j) & 0xFFFF, np.int64(k) & 0xFFFF)
    if (h & np.uint32(0xFFFF)) > density * 65536.0:
        return 0.0
    g = _hash(h, h >> np.uint32(7), np.uint32(91))
    radius = 0.08 + 0.22 * (g & np.uint32(0xFF)) / 255.0
    room = 1.0 - 2.0 * radius
    dx = x - i - radius - room * ((g >> np.uint32(8)) & np.uint32(0xFF)) / 255.0
    dy = y - j - radius - room * ((g >> np.uint32(16)) & np.uint32(0xFF)) / 255.0
    dz = z - k - radius - room * ((g >> np.uint32(24)) & np.uint32(0xFF)) / 255.0
    edge = max(0.5 * footprint / cell, 0.03)
    inside = min(max((radius - np.sqrt(dx * dx + dy * dy + dz * dz)) / edge + 0.5, 0.0), 1.0)
    return float(inside if h & np.uint32(0x10000) else -inside)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def sample_tile(tiles: ByteArray, tile: int, u: float, v: float) -> float:
    """Return the print of a tile at (u, v) in [0, 1]², bilinear, 0 (none) to 1; nothing outside."""
    size_v, size_u = tiles.shape[1], tiles.shape[2]
    x, y = u * size_u - 0.5, v * size_v - 0.5
    if not (0.0 <= x < size_u - 1 and 0.0 <= y < size_v - 1):
        return 0.0
    i, j = int(x), int(y)
    a, b = x - i, y - j
    top = tiles[tile, j, i] + a * (np.float64(tiles[tile, j, i + 1]) - tiles[tile, j, i])
    bottom = tiles[tile, j + 1, i] + a * (np.float64(tiles[tile, j + 1, i + 1]) - tiles[tile, j + 1, i])
    return float((top + b * (bottom - top)) / 255.0)


@numba.njit(cache=True, nogil=True)
def noise_field(table: Float32Array, points: FloatArray, cell: float, octaves: int, persistence: float) -> FloatArray:
    """Return fractal noise at points (N, 3), for the relief of meshes."""
    out = np.empty(len(points))
    for n in range(len(points)):
        out[n] = fractal_noise(table, points[n, 0], points[n, 1], points[n, 2], cell, octaves, persistence, 1e-9)
    return out
