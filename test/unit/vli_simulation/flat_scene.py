"""A plain square with nothing on it, or with a print whose place is known."""

from __future__ import annotations

import numpy as np

from vli_common.arrays import ByteArray
from vli_simulation.mesh import Mesh, grid_faces, make_mesh
from vli_simulation.motion import ScanPath
from vli_simulation.scenes.scene import Material, Scene

PLAIN = Material((0.6, 0.6, 0.6), (0.6, 0.6, 0.6), ink=(0.05, 0.05, 0.05), grain=0.0, speck_density=0.0, gloss=0.0)
PATH = ScanPath(np.zeros(3), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), 0.2)
SMALL = {"rig.width": 320, "rig.height": 240}


def flat(half: float = 0.06, height: float = 0.0, tile: int = -1, printed: float = 0.06) -> Mesh:
    """Return a square in z = height that faces up; a tile covers ±``printed``, u along x and v along y."""
    axis = np.linspace(-half, half, 9)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    vertices = np.stack([x, y, np.full_like(x, height)], axis=-1).reshape(-1, 3)
    return make_mesh(vertices, grid_faces(9, 9)[:, ::-1].copy(), 0, tile, vertices[:, :2] / (2 * printed) + 0.5)


def plain_scene(mesh: Mesh, tiles: ByteArray | None = None) -> Scene:
    """Return a scene of one plain material."""
    return Scene(mesh, (PLAIN,), np.zeros((1, 4, 4), np.uint8) if tiles is None else tiles, PATH)
