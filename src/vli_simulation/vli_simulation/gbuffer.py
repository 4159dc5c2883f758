"""What is seen along each ray before any light falls on it; full images from every second pixel where the surface is smooth.

On a smooth surface the inverse depth is an affine function of the ray, so that three of four pixels need no ray of their own.
Cells of 2×2 pixels whose corners do not lie on one smooth piece of surface are reported, to be cast in full.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numba
import numpy as np

from vli_common.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from vli_simulation.caster import Hits, Int32Array
from vli_simulation.texture import FAST

Weights: TypeAlias = tuple[np.float32, np.float32, np.float32, np.float32]
NOTHING = 255
"""Material where a ray hits nothing."""
_ONE = np.float32(1.0)
_SAME_SURFACE = 1.5e-3
_SAME_NORMAL = 0.95


class GBuffer(NamedTuple):
    """Attributes of N rays.

    Args:
        depth: (N,) along the camera's axis, metres; zero where nothing is hit.
        points: (N, 3) in the world.
        normals: (N, 3) unit, towards the viewer.
        material: (N,) index, ``NOTHING`` where nothing is hit.
        tile: (N,) index of the print, −1 for none; ``uv`` (N, 2) the position on it.
        lit: (N,) whether the light reaches the point.
    """

    depth: Float32Array
    points: Float32Array
    normals: Float32Array
    material: ByteArray
    tile: Int32Array
    uv: Float32Array
    lit: BoolArray

    @staticmethod
    def empty(count: int) -> GBuffer:
        """Return an uninitialised buffer for ``count`` rays."""
        return GBuffer(
            np.empty(count, np.float32),
            np.empty((count, 3), np.float32),
            np.empty((count, 3), np.float32),
            np.empty(count, np.uint8),
            np.empty(count, np.int32),
            np.empty((count, 2), np.float32),
            np.zeros(count, np.bool_),
        )

    def at(self, index: IntArray) -> GBuffer:
        """Return the rays at ``index``."""
        return GBuffer(
            self.depth[index],
            self.points[index],
            self.normals[index],
            self.material[index],
            self.tile[index],
            self.uv[index],
            self.lit[index],
        )


class Surface(NamedTuple):
    """A mesh as the kernels read it.

    Args:
        faces: (F, 3) corners.
        normals: (V, 3) unit.
        material: (F,); ``tile`` (F,) the print, −1 for none.
        uv: (V, 2) position on the print.
    """

    faces: Int32Array
    normals: Float32Array
    material: ByteArray
    tile: Int32Array
    uv: Float32Array


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def resolve(origin: FloatArray, directions: Float32Array, hits: Hits, surface: Surface, out: GBuffer) -> None:
    """Fill ``out`` from hits of rays from ``origin`` along ``directions`` (N, 3), which have unit depth; leaves ``lit`` alone."""
    for n in range(len(hits.triangle)):
        t = hits.triangle[n]
        if t < 0:
            out.depth[n] = 0.0
            out.points[n, :] = 0.0
            out.normals[n, :] = 0.0
            out.material[n] = NOTHING
            out.tile[n] = -1
            continue
        a, b, c = surface.faces[t, 0], surface.faces[t, 1], surface.faces[t, 2]
        u, v = hits.u[n], hits.v[n]
        w = np.float32(1.0) - u - v
        normals = surface.normals
        nx = w * normals[a, 0] + u * normals[b, 0] + v * normals[c, 0]
        ny = w * normals[a, 1] + u * normals[b, 1] + v * normals[c, 1]
        nz = w * normals[a, 2] + u * normals[b, 2] + v * normals[c, 2]
        scale = 1.0 / max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
        if nx * directions[n, 0] + ny * directions[n, 1] + nz * directions[n, 2] > 0.0:
            scale = -scale
        out.normals[n, 0], out.normals[n, 1], out.normals[n, 2] = nx * scale, ny * scale, nz * scale
        out.depth[n] = hits.distance[n]
        for axis in range(3):
            out.points[n, axis] = origin[axis] + np.float64(hits.distance[n]) * directions[n, axis]
        out.material[n] = surface.material[t]
        out.tile[n] = surface.tile[t]
        if surface.tile[t] >= 0:
            for axis in range(2):
                out.uv[n, axis] = w * surface.uv[a, axis] + u * surface.uv[b, axis] + v * surface.uv[c, axis]


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _continues(directions: Float32Array, at: GBuffer, p: int, q: int) -> bool:
    """Return whether ray q ends on the plane through the end of ray p, with nearly the same normal."""
    if at.material[p] != at.material[q] or at.depth[p] <= 0.0 or at.depth[q] <= 0.0:
        return False
    nx, ny, nz = at.normals[p, 0], at.normals[p, 1], at.normals[p, 2]
    if nx * at.normals[q, 0] + ny * at.normals[q, 1] + nz * at.normals[q, 2] < _SAME_NORMAL:
        return False
    along_p = nx * directions[p, 0] + ny * directions[p, 1] + nz * directions[p, 2]
    along_q = nx * directions[q, 0] + ny * directions[q, 1] + nz * directions[q, 2]
    return bool(abs(along_p * at.depth[p] - along_q * at.depth[q]) < _SAME_SURFACE * at.depth[p] * abs(along_q))


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _is_smooth(directions: Float32Array, at: GBuffer, p: int, q: int, r: int, s: int) -> bool:
    """Return whether the corners p q (upper), r s (lower) of a cell lie on one piece of surface, in the same light and print."""
    return (
        at.lit[p] == at.lit[q]
        and at.lit[p] == at.lit[r]
        and at.lit[p] == at.lit[s]
        and at.tile[p] == at.tile[q]
        and at.tile[p] == at.tile[r]
        and at.tile[p] == at.tile[s]
        and _continues(directions, at, p, q)
        and _continues(directions, at, p, r)
        and _continues(directions, at, s, q)
        and _continues(directions, at, s, r)
    )


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _blend(weights: Weights, corners: tuple[int, int, int, int], values: Float32Array, axis: int) -> np.float32:
    """Return the bilinear mean of component ``axis`` at the four corners of a cell."""
    wp, wq, wr, ws = weights
    p, q, r, s = corners
    return np.float32(wp * values[p, axis] + wq * values[q, axis] + wr * values[r, axis] + ws * values[s, axis])


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def enlarge(
    origin: FloatArray,
    coarse_directions: Float32Array,
    coarse: GBuffer,
    directions: Float32Array,
    height: int,
    width: int,
    out: GBuffer,
    rough: BoolArray,
) -> None:
    """Fill the buffer of an image (height, width) from rays through every second pixel of every second row.

    Args:
        origin: (3,) of the camera in the world.
        coarse_directions: (h · w, 3) with h = height // 2 + 1, w = width // 2 + 1, of unit depth, in the world.
        coarse: what lies along them.
        directions: (height · width, 3) of all pixels.
        height: of the image.
        width: of the image.
        out: filled where the surface is smooth, nothing elsewhere.
        rough: (height · width,) set where the pixel must be cast.
    """
    stride = width // 2 + 1
    for row in range((height + 1) // 2):
        for column in range((width + 1) // 2):
            p = row * stride + column
            q, r, s = p + 1, p + stride, p + stride + 1
            smooth = _is_smooth(coarse_directions, coarse, p, q, r, s)
            empty = max(coarse.depth[p], coarse.depth[q], coarse.depth[r], coarse.depth[s]) <= 0.0
            for i in range(2 * row, min(2 * row + 2, height)):
                for j in range(2 * column, min(2 * column + 2, width)):
                    n = i * width + j
                    rough[n] = not (smooth or empty)
                    if not smooth:
                        out.depth[n] = 0.0
                        out.material[n] = NOTHING
                        continue
                    a, b = np.float32(0.5 * (j & 1)), np.float32(0.5 * (i & 1))
                    weights, corners = ((_ONE - a) * (_ONE - b), a * (_ONE - b), (_ONE - a) * b, a * b), (p, q, r, s)
                    inverse = weights[0] / coarse.depth[p] + weights[1] / coarse.depth[q]
                    inverse += weights[2] / coarse.depth[r] + weights[3] / coarse.depth[s]
                    z = np.float32(1.0) / inverse
                    out.depth[n], out.material[n], out.tile[n], out.lit[n] = z, coarse.material[p], coarse.tile[p], coarse.lit[p]
                    nx = _blend(weights, corners, coarse.normals, 0)
                    ny = _blend(weights, corners, coarse.normals, 1)
                    nz = _blend(weights, corners, coarse.normals, 2)
                    scale = 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz)
                    out.normals[n, 0], out.normals[n, 1], out.normals[n, 2] = nx * scale, ny * scale, nz * scale
                    for axis in range(3):
                        out.points[n, axis] = origin[axis] + z * directions[n, axis]
                    if coarse.tile[p] >= 0:
                        out.uv[n, 0] = _blend(weights, corners, coarse.uv, 0)
                        out.uv[n, 1] = _blend(weights, corners, coarse.uv, 1)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def turn(rotation: FloatArray, rays: Float32Array, out: Float32Array) -> None:
    """Fill ``out`` with rays (N, 3) turned by a rotation (3, 3); BLAS would wake its threads for this."""
    for n in range(len(rays)):
        x, y, z = rays[n, 0], rays[n, 1], rays[n, 2]
        for axis in range(3):
            out[n, axis] = rotation[axis, 0] * x + rotation[axis, 1] * y + rotation[axis, 2] * z
