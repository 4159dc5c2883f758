"""Light on surfaces: what colour is there, how bright the LED and the laser make it. World coordinates; N rays."""

from __future__ import annotations

import numba
import numpy as np

from vli_common.arrays import ByteArray, Float32Array, FloatArray
from vli_simulation.gbuffer import NOTHING, GBuffer
from vli_simulation.texture import FAST, fractal_noise, sample_tile, speck

AMBIENT = 0.05
"""Light that reaches every surface by reflection, as a share of direct light at the nominal distance."""


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def surface_albedo(
    at: GBuffer, focal_px: float, materials: FloatArray, tiles: ByteArray, table: Float32Array, albedo: Float32Array
) -> None:
    """Fill ``albedo`` (N, 3), order blue, green, red, with detail down to the size of a pixel on the surface, depth / focal."""
    for n in range(len(at.depth)):
        if at.material[n] == NOTHING:
            albedo[n, :] = 0.0
            continue
        m = materials[at.material[n]]
        x, y, z = np.float64(at.points[n, 0]), np.float64(at.points[n, 1]), np.float64(at.points[n, 2])
        size = max(at.depth[n] / focal_px, 1e-6)
        stain = fractal_noise(table, 0.6 * x + 0.8 * y + 0.31, 0.6 * y - 0.8 * x, z, m[9], 1, 0.7, size)
        mixed = min(max((stain - 1.2 + 2.0 * m[10]) * 0.8 + 0.1, 0.0), 1.0)
        gain = max(1.0 + m[12] * fractal_noise(table, x / m[14], y, z, m[11], 2, m[13], size), 0.15)
        if m[16] > 0.0:
            gain *= 1.0 + m[17] * speck(x, y, z, m[15], m[16], size)
        ink = sample_tile(tiles, at.tile[n], at.uv[n, 0], at.uv[n, 1]) if at.tile[n] >= 0 else 0.0
        for channel in range(3):
            k = 2 - channel
            base = (m[k] + mixed * (m[3 + k] - m[k])) * gain
            albedo[n, channel] = max(base + ink * (m[6 + k] * (0.6 + 0.4 * gain) - base), 0.0)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def illuminate(
    at: GBuffer,
    albedo: Float32Array,
    materials: FloatArray,
    eye: FloatArray,
    light: FloatArray,
    light_axis: FloatArray,
    nominal: float,
    radiance: Float32Array,
) -> None:
    """Fill ``radiance`` (N, 3): 1 is a white surface that faces the light at ``nominal`` metres.

    Inverse-square and cosine fall-off, the LED's own cosine lobe about ``light_axis``, a Blinn highlight, and ambient light.
    """
    for n in range(len(at.depth)):
        if at.material[n] == NOTHING:
            radiance[n, :] = 0.0
            continue
        m = materials[at.material[n]]
        x, y, z = at.points[n, 0], at.points[n, 1], at.points[n, 2]
        nx, ny, nz = at.normals[n, 0], at.normals[n, 1], at.normals[n, 2]
        lx, ly, lz = light[0] - x, light[1] - y, light[2] - z
        ex, ey, ez = eye[0] - x, eye[1] - y, eye[2] - z
        r2 = lx * lx + ly * ly + lz * lz
        r = 1.0 / np.sqrt(r2)
        e = 1.0 / np.sqrt(ex * ex + ey * ey + ez * ez)
        diffuse = AMBIENT * (0.4 + 0.6 * nominal * e)
        highlight = 0.0
        cosine = (nx * lx + ny * ly + nz * lz) * r
        if at.lit[n] and cosine > 0.0:
            lobe = max(-(lx * light_axis[0] + ly * light_axis[1] + lz * light_axis[2]) * r, 0.0)
            strength = nominal * nominal / r2 * lobe
            diffuse += strength * cosine
            hx, hy, hz = lx * r + ex * e, ly * r + ey * e, lz * r + ez * e
            half = (nx * hx + ny * hy + nz * hz) / np.sqrt(hx * hx + hy * hy + hz * hz)
            # Schlick's rational stand-in for half ** shininess: a power costs as much as all the rest.
            highlight = m[18] * strength * half / (m[19] - m[19] * half + half) if half > 0.0 else 0.0
        for channel in range(3):
            radiance[n, channel] = albedo[n, channel] * diffuse + highlight * (0.4 + 0.6 * albedo[n, channel])


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def sheet_irradiance(
    at: GBuffer, origin: FloatArray, plane: FloatArray, waist: float, divergence: float, nominal: float, out: Float32Array
) -> None:
    """Fill ``out`` (N,): 1 where a surface that faces the laser at ``nominal`` metres is cut by the middle of the sheet.

    The sheet's profile is Gaussian, sigma = waist + divergence · r; its power spreads over a line, hence 1/r, and over its width.
    """
    reference = waist + divergence * nominal
    for n in range(len(at.depth)):
        out[n] = 0.0
        if at.material[n] == NOTHING:
            continue
        s = plane[0] * at.points[n, 0] + plane[1] * at.points[n, 1] + plane[2] * at.points[n, 2] + plane[3]
        x, y, z = origin[0] - at.points[n, 0], origin[1] - at.points[n, 1], origin[2] - at.points[n, 2]
        r = np.sqrt(x * x + y * y + z * z)
        sigma = waist + divergence * r
        if abs(s) > 4.5 * sigma:
            continue
        cosine = max((at.normals[n, 0] * x + at.normals[n, 1] * y + at.normals[n, 2] * z) / r, 0.0)
        out[n] = np.exp(-0.5 * (s / sigma) ** 2) * cosine * (nominal / r) * (reference / sigma)
