"""A coloured triangle mesh of a cloud with normals, trimmed where nothing was seen.

The surface is where the signed distance to the tangent planes of the points around, weighted by nearness, is zero (Hoppe et al.,
"Surface reconstruction from unorganized points", 1992), by marching cubes. Only cubes near points count, so that no web spans
what lies between; and space is worked through in blocks, so that memory follows the surface and not the space around it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit

from vli_common.arrays import ByteArray, Float32Array, FloatArray, IntArray
from vli_common.errors import OutputError
from vli_common.types import PointCloud
from vli_mapping.optional import optional
from vli_mapping.store import replacing

EXTRA = "mesh"
MESH_SUFFIXES = (".ply", ".stl", ".obj", ".glb")
VOXEL_M = 2.5e-4
_REACH_VOXELS = 4
"""A point says where the surface is this far around it: stripes of a quick hand are some 0.5 mm apart."""
_SIGMA_VOXELS = 1.4
_TRIM_VOXELS = 2.4
"""Vertices farther from any point are gone: the reach without what is only extrapolated."""
_BLOCK = 96
_MIN_WEIGHT = 0.02
_LEVEL = 1e-4
"""Voxels; not zero, or a plane that coincides with the face of two blocks crosses neither."""


@dataclass(frozen=True, slots=True)
class ColouredMesh:
    """Triangles that face the sensor: vertices (V, 3) metres, faces (F, 3), colours (V, 3) uint8 RGB."""

    vertices: Float32Array
    faces: IntArray
    colours: ByteArray


def write_mesh(path: Path, mesh: ColouredMesh) -> None:
    """Write a mesh in the format that the file's ending names, whole or not at all; STL has no colours.

    Raises:
        OutputError: unknown ending, trimesh is not installed, or the file cannot be written.
    """
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise OutputError(f"'{path}' ends in '{path.suffix}', expected one of {', '.join(MESH_SUFFIXES)} for a mesh")
    trimesh = optional("trimesh", EXTRA)
    opaque = np.column_stack([mesh.colours, np.full(len(mesh.colours), 255, np.uint8)])
    item = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=opaque, process=False)
    with replacing(path) as partial:
        item.export(partial, file_type=path.suffix[1:].lower())


def make_mesh(cloud: PointCloud, voxel_m: float = VOXEL_M) -> ColouredMesh:
    """Return the mesh of a cloud.

    Args:
        cloud: with normals; points without one do not count.
        voxel_m: edge of a marching cube, metres; smaller: finer, and holes where points are farther apart.

    Raises:
        OutputError: scikit-image is not installed, or no point has a normal.
    """
    from scipy.spatial import KDTree

    measure = optional("skimage.measure", EXTRA)
    flat = cloud.normals.any(axis=1) if cloud.normals is not None else np.zeros(len(cloud), np.bool_)
    if cloud.normals is None or not flat.any():
        raise OutputError("no point of the map has a normal, there is no surface to mesh; scan for longer, or closer")
    points, normals = cloud.points[flat].astype(np.float64), cloud.normals[flat].astype(np.float64)
    parts = [_mesh_block(measure, points, normals, block, voxel_m) for block in _blocks(points, voxel_m)]
    vertices, faces = _joined([part for part in parts if part is not None], voxel_m)
    tree = KDTree(points)
    near = [np.asarray(item).reshape(len(vertices), -1) for item in tree.query(vertices, k=min(4, len(points)))]
    distance, nearest = near[0].astype(np.float64), near[1].astype(np.int64)
    faces = faces[(distance[:, 0] < _TRIM_VOXELS * voxel_m)[faces].all(axis=1)]
    weight = 1.0 / (distance + 0.1 * voxel_m) ** 2
    colours = (cloud.colours[flat][nearest] * weight[..., None]).sum(axis=1) / weight.sum(axis=1)[:, None]
    used, index = np.unique(faces, return_inverse=True)
    return ColouredMesh(
        vertices[used].astype(np.float32), index.reshape(-1, 3).astype(np.int64), np.rint(colours[used]).astype(np.uint8)
    )


def _blocks(points: FloatArray, voxel_m: float) -> IntArray:
    """Return the first voxel (B, 3) of each block that a point reaches into, in order."""
    cells = np.floor(points / voxel_m).astype(np.int64)
    offsets = _REACH_VOXELS * (np.indices((3, 3, 3)).reshape(3, -1).T - 1)
    reached = [np.unique((cells + offset) // _BLOCK, axis=0) for offset in offsets]
    blocks: IntArray = np.unique(np.concatenate(reached), axis=0) * _BLOCK
    return blocks


def _mesh_block(
    measure: object, points: FloatArray, normals: FloatArray, first: IntArray, voxel_m: float
) -> tuple[FloatArray, IntArray] | None:
    """Return vertices, in voxels of the whole, and faces of one block; None where nothing crosses it."""
    low, high = (first - _REACH_VOXELS - 1) * voxel_m, (first + _BLOCK + _REACH_VOXELS + 2) * voxel_m
    near = ((points >= low) & (points <= high)).all(axis=1)
    # One more voxel than cubes: neighbours share the face between them.
    shape = (_BLOCK + 1,) * 3
    total, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    _splat(points[near] / voxel_m - first, normals[near], total, weight)
    known = weight > _MIN_WEIGHT
    field = np.where(known, total / np.maximum(weight, _MIN_WEIGHT), 1.0).astype(np.float32)
    if not known.any() or field[known].min() >= _LEVEL or field[known].max() <= _LEVEL:
        return None
    try:
        vertices, faces, _, _ = measure.marching_cubes(  # type: ignore[attr-defined]
            field, _LEVEL, mask=known, gradient_direction="descent", allow_degenerate=False
        )
    except (RuntimeError, ValueError):
        # It says so where no cube whose corners are all known is crossed.
        return None
    return vertices + first, faces.astype(np.int64)


@njit(cache=True, nogil=True)
def _splat(points, normals, total, weight):  # type: ignore[no-untyped-def]
    """Add the signed distances to the tangent planes of points (N, 3), in voxels of the block, to the voxels around each."""
    reach, size = _REACH_VOXELS, total.shape[0]
    for index in range(len(points)):
        p, n = points[index], normals[index]
        for i in range(max(int(np.floor(p[0])) - reach + 1, 0), min(int(np.floor(p[0])) + reach + 1, size)):
            for j in range(max(int(np.floor(p[1])) - reach + 1, 0), min(int(np.floor(p[1])) + reach + 1, size)):
                for k in range(max(int(np.floor(p[2])) - reach + 1, 0), min(int(np.floor(p[2])) + reach + 1, size)):
                    x, y, z = i - p[0], j - p[1], k - p[2]
                    squared = x * x + y * y + z * z
                    if squared > reach * reach:
                        continue
                    share = np.exp(-squared / (2 * _SIGMA_VOXELS * _SIGMA_VOXELS))
                    total[i, j, k] += share * (n[0] * x + n[1] * y + n[2] * z)
                    weight[i, j, k] += share


def _joined(parts: list[tuple[FloatArray, IntArray]], voxel_m: float) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3), metres, and faces (F, 3) of all blocks, sewn together where they meet."""
    if not parts:
        raise OutputError(f"no surface is dense enough for a mesh of '{1e3 * voxel_m:g}' mm voxels; scan more slowly")
    firsts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([faces + first for (_, faces), first in zip(parts, firsts, strict=False)])
    # Blocks compute the same vertex from the same numbers, but for the last bits.
    _, index, inverse = np.unique(np.rint(vertices * 4096).astype(np.int64), axis=0, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[faces]
    first, second, third = faces.T
    # Slivers thinner than these bits lose a corner.
    return vertices[index] * voxel_m, faces[(first != second) & (second != third) & (third != first)]
