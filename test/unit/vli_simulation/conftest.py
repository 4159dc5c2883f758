"""Small scenes with known answers, and the rendered keyboard that several tests look at."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from vli_common.arrays import ByteArray
from vli_simulation.config import make_config
from vli_simulation.mesh import Mesh, grid_faces, make_mesh
from vli_simulation.motion import ScanPath
from vli_simulation.scenes.scene import Material, Scene
from vli_simulation.simulate import Simulation

PLAIN = Material((0.6, 0.6, 0.6), (0.6, 0.6, 0.6), ink=(0.05, 0.05, 0.05), grain=0.0, speck_density=0.0, gloss=0.0)
PATH = ScanPath(np.zeros(3), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), 0.2)
SMALL = {"rig.width": 320, "rig.height": 240}


def flat(half: float = 0.06, height: float = 0.0, tile: int = -1, printed: float = 0.06) -> Mesh:
    """Return a square in z = height that faces up; a tile covers ±``printed``, u along x and v along y."""
    axis = np.linspace(-half, half, 9)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    vertices = np.stack([x, y, np.full_like(x, height)], axis=-1).reshape(-1, 3)
    return make_mesh(vertices, grid_faces(9, 9)[:, ::-1].copy(), 0, tile, vertices[:, :2] / (2 * printed) + 0.5)


@pytest.fixture
def make_scene() -> Callable[..., Scene]:
    """Return a function that makes a scene of one plain material from a mesh and, if wanted, tiles."""

    def make(mesh: Mesh, tiles: ByteArray | None = None, material: Material = PLAIN) -> Scene:
        return Scene(mesh, (material,), np.zeros((1, 4, 4), np.uint8) if tiles is None else tiles, PATH)

    return make


@pytest.fixture(scope="session")
def keyboard() -> Simulation:
    """Return a small keyboard recording, not yet rendered."""
    return Simulation("keyboard", make_config("smoke", {**SMALL, "motion.rest_s": 0.5, "motion.duration_s": 2.0}), 3)
