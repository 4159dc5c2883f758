"""Triangle meshes and the few ways in which the scenes build them: grids and lofts of rounded rectangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vli_common.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class Mesh:
    """Triangles of one or more materials.

    Args:
        vertices: (V, 3) metres.
        faces: (F, 3) counter-clockwise seen from outside.
        material: (F,) index into the scene's materials.
        tile: (F,) index of the printed tile, −1 where nothing is printed.
        uv: (V, 2) position on the tile, 0 to 1 within it.
    """

    vertices: FloatArray
    faces: IntArray
    material: IntArray
    tile: IntArray
    uv: FloatArray


def make_mesh(vertices: FloatArray, faces: IntArray, material: int, tile: int = -1, uv: FloatArray | None = None) -> Mesh:
    """Return a mesh of one material, with at most one printed tile."""
    count = len(faces)
    return Mesh(
        vertices, faces, np.full(count, material), np.full(count, tile), np.zeros((len(vertices), 2)) if uv is None else uv
    )


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Return several meshes as one."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]),
        np.concatenate([mesh.material for mesh in meshes]),
        np.concatenate([mesh.tile for mesh in meshes]),
        np.concatenate([mesh.uv for mesh in meshes]),
    )


def vertex_normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return area-weighted unit normals (V, 3)."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    index = faces.ravel()
    total = np.stack([np.bincount(index, np.repeat(normal[:, axis], 3), len(vertices)) for axis in range(3)], axis=1)
    result: FloatArray = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
    return result


def grid_faces(rows: int, columns: int, closed: bool = False) -> IntArray:
    """Return the triangles of a grid of rows × columns vertices in row-major order.

    Args:
        rows, columns: of vertices.
        closed: join the last column to the first.
    """
    index = np.arange(rows * columns).reshape(rows, columns)
    right = np.roll(index, -1, axis=1)
    cells = slice(None) if closed else slice(None, -1)
    a, b = index[:-1, cells].ravel(), right[:-1, cells].ravel()
    d, c = index[1:, cells].ravel(), right[1:, cells].ravel()
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def rounded_rectangle(half_x: float, half_y: float, radius: float, corner: int = 8, edge: int = 6) -> FloatArray:
    """Return a closed outline (4 · (corner + edge), 2), counter-clockwise; the same count whatever the size."""
    radius = min(radius, half_x, half_y)
    points = []
    for quarter in range(4):
        angle = np.pi / 2 * (quarter + np.arange(corner) / (corner - 1))
        sign_x, sign_y = (1, -1, -1, 1)[quarter], (1, 1, -1, -1)[quarter]
        arc = np.stack(
            [sign_x * (half_x - radius) + radius * np.cos(angle), sign_y * (half_y - radius) + radius * np.sin(angle)], axis=1
        )
        points.append(arc)
    outline = []
    for quarter in range(4):
        start, end = points[quarter][-1], points[(quarter + 1) % 4][0]
        step = (np.arange(edge) + 1)[:, None] / (edge + 1)
        outline += [points[quarter], start + step * (end - start)]
    return np.concatenate(outline)


def loft(rings: Sequence[FloatArray], apex: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return (vertices, faces) of a shell through rising rings (K, 3), counter-clockwise from above, closed by an apex (3,)."""
    count = len(rings[0])
    vertices = np.concatenate([*rings, apex[None]])
    last = (len(rings) - 1) * count + np.arange(count)
    cap = np.stack([last, np.roll(last, -1), np.full(count, len(vertices) - 1)], axis=1)
    return vertices, np.concatenate([grid_faces(len(rings), count, closed=True), cap])
