"""What is seen along each ray before any light falls on it; full images from every second pixel where the surface is smooth.

On a smooth surface the inverse depth is an affine function of the ray, so that three of four pixels need no ray of their own.
Cells of 2×2 pixels whose corners do not lie on one smooth piece of surface are reported, to be cast in full.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from vli_common.arrays import BoolArray, ByteArray, Float32Array
from vli_simulation.texture import FAST

NOTHING = 255
"""Material where a ray hits nothing."""
_SAME_SURFACE = 1.5e-3
_SAME_NORMAL = 0.95


@dataclass(frozen=True)
class GBuffer:
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
    tile: np.ndarray[tuple[int, ...], np.dtype[np.int32]]
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

    def __len__(self) -> int:
        return len(self.depth)

    def at(self, index: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> GBuffer:
        """Return the rays at ``index``."""
        return GBuffer(
            self.depth[index], self.points[index], self.normals[index], self.material[index], self.tile[index], self.uv[index], self.lit[index]
        )


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def resolve(
    origin, directions, distance, u, v, triangle, faces, vertex_normals, material_of, tile_of, vertex_uv, depth, points, normals, material, tile, uv
):
    """Fill depth, points, interpolated normals (towards the viewer), material and print of hits; ``directions`` have unit depth."""
    for n in range(len(triangle)):
        t = triangle[n]
        if t < 0:
            depth[n] = 0.0
            points[n, :] = 0.0
            normals[n, :] = 0.0
            material[n] = NOTHING
            tile[n] = -1
            continue
        a, b, c = faces[t, 0], faces[t, 1], faces[t, 2]
        w = np.float32(1.0) - u[n] - v[n]
        nx = w * vertex_normals[a, 0] + u[n] * vertex_normals[b, 0] + v[n] * vertex_normals[c, 0]
        ny = w * vertex_normals[a, 1] + u[n] * vertex_normals[b, 1] + v[n] * vertex_normals[c, 1]
        nz = w * vertex_normals[a, 2] + u[n] * vertex_normals[b, 2] + v[n] * vertex_normals[c, 2]
        scale = 1.0 / max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
        if nx * directions[n, 0] + ny * directions[n, 1] + nz * directions[n, 2] > 0.0:
            scale = -scale
        normals[n, 0], normals[n, 1], normals[n, 2] = nx * scale, ny * scale, nz * scale
        depth[n] = distance[n]
        for axis in range(3):
            points[n, axis] = origin[axis] + np.float64(distance[n]) * directions[n, axis]
        material[n] = material_of[t]
        tile[n] = tile_of[t]
        if tile_of[t] >= 0:
            for axis in range(2):
                uv[n, axis] = w * vertex_uv[a, axis] + u[n] * vertex_uv[b, axis] + v[n] * vertex_uv[c, axis]


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _continues(d, depth, normals, material, p, q):
    """Return whether corner q lies on the plane through corner p, with nearly the same normal."""
    if material[p] != material[q] or depth[p] <= 0.0 or depth[q] <= 0.0:
        return False
    nx, ny, nz = normals[p, 0], normals[p, 1], normals[p, 2]
    if nx * normals[q, 0] + ny * normals[q, 1] + nz * normals[q, 2] < _SAME_NORMAL:
        return False
    at_p = nx * d[p, 0] + ny * d[p, 1] + nz * d[p, 2]
    at_q = nx * d[q, 0] + ny * d[q, 1] + nz * d[q, 2]
    return abs(at_p * depth[p] - at_q * depth[q]) < _SAME_SURFACE * depth[p] * abs(at_q)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def enlarge(
    origin, coarse_directions, c_depth, c_normals, c_material, c_tile, c_uv, c_lit, directions, height, width,
    depth, points, normals, material, tile, uv, lit, rough,
):  # fmt: skip
    """Fill the buffer of an image (height, width) from rays through every second pixel of every second row.

    Args:
        origin: (3,) of the camera in the world.
        coarse_directions: (h, w, 3) with h = height // 2 + 1, w = width // 2 + 1, of unit depth, in the world; ``c_*`` their attributes, flat.
        directions: (height · width, 3) of all pixels.
        rough: (height · width,) set where the pixel must be cast.
    """
    stride = width // 2 + 1
    for p_row in range((height + 1) // 2):
        for p_column in range((width + 1) // 2):
            p = p_row * stride + p_column
            q, r, s = p + 1, p + stride, p + stride + 1
            empty = c_material[p] == NOTHING and c_material[q] == NOTHING and c_material[r] == NOTHING and c_material[s] == NOTHING
            smooth = (
                c_lit[p] == c_lit[q] and c_lit[p] == c_lit[r] and c_lit[p] == c_lit[s]
                and c_tile[p] == c_tile[q] and c_tile[p] == c_tile[r] and c_tile[p] == c_tile[s]
                and _continues(coarse_directions, c_depth, c_normals, c_material, p, q)
                and _continues(coarse_directions, c_depth, c_normals, c_material, p, r)
                and _continues(coarse_directions, c_depth, c_normals, c_material, s, q)
                and _continues(coarse_directions, c_depth, c_normals, c_material, s, r)
            )  # fmt: skip
            for i in range(2 * p_row, min(2 * p_row + 2, height)):
                for j in range(2 * p_column, min(2 * p_column + 2, width)):
                    n = i * width + j
                    rough[n] = not (smooth or empty)
                    if not smooth:
                        depth[n] = 0.0
                        material[n] = NOTHING
                        continue
                    a, b = np.float32(0.5 * (j & 1)), np.float32(0.5 * (i & 1))
                    wp, wq, wr, ws = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
                    z = np.float32(1.0) / (wp / c_depth[p] + wq / c_depth[q] + wr / c_depth[r] + ws / c_depth[s])
                    depth[n], material[n], tile[n], lit[n] = z, c_material[p], c_tile[p], c_lit[p]
                    nx = wp * c_normals[p, 0] + wq * c_normals[q, 0] + wr * c_normals[r, 0] + ws * c_normals[s, 0]
                    ny = wp * c_normals[p, 1] + wq * c_normals[q, 1] + wr * c_normals[r, 1] + ws * c_normals[s, 1]
                    nz = wp * c_normals[p, 2] + wq * c_normals[q, 2] + wr * c_normals[r, 2] + ws * c_normals[s, 2]
                    scale = np.float32(1.0) / np.sqrt(nx * nx + ny * ny + nz * nz)
                    normals[n, 0], normals[n, 1], normals[n, 2] = nx * scale, ny * scale, nz * scale
                    for axis in range(3):
                        points[n, axis] = origin[axis] + z * directions[n, axis]
                    if c_tile[p] >= 0:
                        for axis in range(2):
                            uv[n, axis] = wp * c_uv[p, axis] + wq * c_uv[q, axis] + wr * c_uv[r, axis] + ws * c_uv[s, axis]


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def turn(rotation, rays, out):
    """Fill ``out`` with rays (N, 3) turned by a rotation (3, 3); BLAS would wake its threads for this."""
    for n in range(len(rays)):
        x, y, z = rays[n, 0], rays[n, 1], rays[n, 2]
        for axis in range(3):
            out[n, axis] = rotation[axis, 0] * x + rotation[axis, 1] * y + rotation[axis, 2] * z
