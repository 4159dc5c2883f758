"""Rays against the scene's mesh, by Embree."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from vli_common.arrays import BoolArray, Float32Array, FloatArray
from vli_simulation.mesh import Mesh, vertex_normals

Int32Array: TypeAlias = np.ndarray[tuple[int, ...], np.dtype[np.int32]]

_CLEARANCE = 0.998
"""A shadow ray ends this share of the way before the surface: 60 µm at 30 mm, lest it hit where it started."""


class Hits(NamedTuple):
    """First hits of N rays: distance in lengths of the direction, barycentric u, v, triangle (−1 where nothing was hit)."""

    distance: Float32Array
    u: Float32Array
    v: Float32Array
    triangle: Int32Array


class RayCaster:
    """A mesh that rays can be cast against; safe to use from several threads."""

    def __init__(self, mesh: Mesh) -> None:
        # What is cast is single precision: the truth that is written must be the same numbers.
        self.vertices: Float32Array = np.ascontiguousarray(mesh.vertices, dtype=np.float32)
        self.faces = np.ascontiguousarray(mesh.faces, dtype=np.int32)
        self.normals: Float32Array = vertex_normals(mesh.vertices, mesh.faces).astype(np.float32)
        self._scene = EmbreeScene()
        self._geometry = TriangleMesh(self._scene, self.vertices, self.faces)
        # Embree builds its hierarchy on first use, which must not happen in two threads at once.
        self.cast(np.zeros(3), np.array([[0.0, 0.0, 1.0]]))

    def cast(self, origin: FloatArray, directions: FloatArray | Float32Array) -> Hits:
        """Return the first hits of rays from one origin (3,) along directions (N, 3)."""
        rays = np.ascontiguousarray(directions, dtype=np.float32)
        found = self._scene.run(_repeat(origin, len(rays)), rays, output=1)
        return Hits(found["tfar"], found["u"], found["v"], found["primID"])

    def visible(self, origin: FloatArray, points: Float32Array) -> BoolArray:
        """Return for each point (N, 3) whether a straight line from ``origin`` (3,) reaches it."""
        start = origin.astype(np.float32)
        found = self._scene.run(
            _repeat(origin, len(points)), points - start, query="OCCLUDED", dists=np.full(len(points), _CLEARANCE, np.float32)
        )
        result: BoolArray = found < 0
        return result


def _repeat(origin: FloatArray, count: int) -> Float32Array:
    rows = np.empty((count, 3), np.float32)
    rows[:] = origin
    return rows
