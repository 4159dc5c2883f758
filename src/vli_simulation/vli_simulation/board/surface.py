"""A printed plate on a table: two parallel planes, cut by rays in closed form. Metres, board frame: z away from the viewer."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from vli_calibration.targets import Target
from vli_common.arrays import ByteArray, Float32Array, FloatArray
from vli_simulation.gbuffer import NOTHING, GBuffer
from vli_simulation.scenes.scene import Material
from vli_simulation.texture import FAST

PAPER, TABLE = 0, 1
_INK = (0.045, 0.045, 0.045)
_TABLE_HALF = 0.6
_FINEST_M = 2.0e-5
_LARGEST_RASTER_PX = 6.0e7


@dataclass(frozen=True)
class BoardSurface:
    """A target as the kernels read it.

    Args:
        ink: (H, W) uint8, share of each raster cell that is black.
        origin: (2,) metres, centre of raster cell (0, 0).
        scale: raster cells a metre.
        outline: (4,) x0, y0, x1, y1 of the plate.
        thickness: of the plate; the table lies at z = thickness.
        materials: (2, M) rows of :class:`Material`, paper and table.
    """

    ink: ByteArray
    origin: FloatArray
    scale: float
    outline: FloatArray
    thickness: float
    materials: FloatArray

    @property
    def ink_albedo(self) -> Float32Array:
        """Albedo of the print (3,), blue green red."""
        return np.array(_INK[::-1], dtype=np.float32)


def make_surface(target: Target, thickness: float, gloss: float, finest_m: float) -> BoardSurface:
    """Return the plate with a target on it.

    Args:
        target: what is printed.
        thickness: of the plate, metres.
        gloss: of paper and toner.
        finest_m: size of a pixel on the board where it is nearest; the raster is as fine.
    """
    x0, y0, x1, y1 = target.extent
    sides = (x1 - x0 + 2 * target.margin) * (y1 - y0 + 2 * target.margin)
    scale = min(1.0 / max(finest_m, _FINEST_M), np.sqrt(_LARGEST_RASTER_PX / sides))
    grey, origin = target.raster(scale)
    corner = origin - 0.5 / scale
    outline = np.array([*corner, *(corner + np.array(grey.shape[::-1]) / scale)])
    paper = Material(
        (0.80, 0.80, 0.78), (0.76, 0.76, 0.73), grain=0.015, speck_density=0.02, speck=0.1, gloss=gloss, shininess=40.0
    )
    table = Material((0.24, 0.21, 0.18), (0.16, 0.14, 0.12), grain=0.15, stain_cell=0.02, speck_density=0.1, gloss=0.02)
    materials = np.array([paper.row(), table.row()])
    return BoardSurface(255 - grey, origin, float(scale), outline, thickness, materials)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def reaches(source: FloatArray, x: float, y: float, z: float, outline: FloatArray) -> bool:
    """Return whether a straight line from ``source`` (3,) reaches a point; the plate's front hides the table."""
    if source[2] >= 0.0:
        return False
    if z <= 0.0:
        return True
    share = source[2] / (source[2] - z)
    at_x, at_y = source[0] + share * (x - source[0]), source[1] + share * (y - source[1])
    return not (outline[0] <= at_x <= outline[2] and outline[1] <= at_y <= outline[3])


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def hide(source: FloatArray, at: GBuffer, outline: FloatArray, light: Float32Array) -> None:
    """Set ``light`` (N,) to zero where the plate hides the ends of rays from ``source`` (3,)."""
    for n in range(len(light)):
        if light[n] > 0.0 and not reaches(source, at.points[n, 0], at.points[n, 1], at.points[n, 2], outline):
            light[n] = 0.0


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def look(
    eye: FloatArray, directions: Float32Array, outline: FloatArray, thickness: float, light: FloatArray, out: GBuffer
) -> None:
    """Fill ``out`` with what lies along rays from ``eye`` (3,) along ``directions`` (N, 3), which have unit depth."""
    for n in range(len(directions)):
        dx, dy, dz = np.float64(directions[n, 0]), np.float64(directions[n, 1]), np.float64(directions[n, 2])
        out.tile[n] = -1
        out.material[n] = NOTHING
        out.depth[n] = 0.0
        out.lit[n] = False
        out.points[n, :] = 0.0
        out.uv[n, :] = 0.0
        out.normals[n, 0], out.normals[n, 1], out.normals[n, 2] = 0.0, 0.0, -1.0
        if dz < 1e-9 or eye[2] >= 0.0:
            continue
        depth, z, material = -eye[2] / dz, 0.0, PAPER
        x, y = eye[0] + depth * dx, eye[1] + depth * dy
        if not (outline[0] <= x <= outline[2] and outline[1] <= y <= outline[3]):
            depth, z, material = (thickness - eye[2]) / dz, thickness, TABLE
            x, y = eye[0] + depth * dx, eye[1] + depth * dy
            if max(abs(x), abs(y)) > _TABLE_HALF:
                continue
        out.depth[n], out.material[n] = depth, material
        out.points[n, 0], out.points[n, 1], out.points[n, 2] = x, y, z
        out.lit[n] = reaches(light, x, y, z, outline)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _ink_at(eye: FloatArray, rotation: FloatArray, x: float, y: float, ink: ByteArray, origin: FloatArray, scale: float) -> float:
    """Return the ink, 0 to 255, where the ray (x, y, 1) of the camera frame meets the board; bilinear, none outside the print."""
    dz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]
    if dz < 1e-9:
        return 0.0
    depth = -eye[2] / dz
    p = (eye[0] + depth * (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]) - origin[0]) * scale
    q = (eye[1] + depth * (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2]) - origin[1]) * scale
    if not (0.0 <= p < ink.shape[1] - 1 and 0.0 <= q < ink.shape[0] - 1):
        return 0.0
    i, j = int(q), int(p)
    p, q = p - j, q - i
    top = ink[i, j] + p * (np.float64(ink[i, j + 1]) - ink[i, j])
    bottom = ink[i + 1, j] + p * (np.float64(ink[i + 1, j + 1]) - ink[i + 1, j])
    return float(top + q * (bottom - top))


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def ink_share(
    eye: FloatArray,
    rotation: FloatArray,
    rays: Float32Array,
    spans: Float32Array,
    offsets: FloatArray,
    material: ByteArray,
    ink: ByteArray,
    origin: FloatArray,
    scale: float,
    out: Float32Array,
) -> None:
    """Fill ``out`` (N,) with the share of ink in each ray's pixel, 0 to 1.

    Args:
        eye: (3,) of the camera in the board frame; ``rotation`` (3, 3) of the camera.
        rays: (N, 3) of unit depth in the camera frame.
        spans: (N, 4) how the ray's x, y change over one pixel to the right, then over one pixel down.
        offsets: (K, 2) samples within the pixel, in pixels from its centre, for pixels that an edge crosses; none:
            rays stand for themselves.
        material: (N,) what the rays meet; there is ink on paper only.
        ink, origin, scale: see :class:`BoardSurface`.
        out: result.
    """
    for n in range(len(rays)):
        out[n] = 0.0
        if material[n] != PAPER:
            continue
        middle = _ink_at(eye, rotation, rays[n, 0], rays[n, 1], ink, origin, scale)
        out[n] = middle / 255.0
        if len(offsets) == 0:
            continue
        uniform = True
        for corner in range(4):
            a, b = 0.5 - (corner & 1), 0.5 - (corner >> 1)
            x, y = rays[n, 0] + a * spans[n, 0] + b * spans[n, 2], rays[n, 1] + a * spans[n, 1] + b * spans[n, 3]
            uniform = uniform and abs(_ink_at(eye, rotation, x, y, ink, origin, scale) - middle) < 0.5
        if not uniform:
            total = 0.0
            for k in range(len(offsets)):
                a, b = offsets[k, 0], offsets[k, 1]
                x, y = rays[n, 0] + a * spans[n, 0] + b * spans[n, 2], rays[n, 1] + a * spans[n, 1] + b * spans[n, 3]
                total += _ink_at(eye, rotation, x, y, ink, origin, scale)
            out[n] = total / (255.0 * len(offsets))
