"""A flat plate and a round bar, printed but without relief: along them the shape alone says nothing of where the scanner is."""

from __future__ import annotations

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.geometry import so3_exp
from vli_simulation.mesh import Mesh, grid_faces, make_mesh
from vli_simulation.motion import ScanPath
from vli_simulation.scenes.scene import Material, Scene, jitter, print_tile

_LENGTH, _MARGIN = 0.40, 0.03
_HALF_WIDTH = 0.045
_STEP = 0.5e-3
_BAR_RADIUS = 0.022
_TILT_DEG = (2.0, -3.0)
_MARKS = ("A7", "K2", "19", "R", "5C", "M8")
_MARK_SIZE, _MARK_PITCH = 0.014, 0.019


def make_plate(seed: int) -> Scene:
    """Return a flat plate; what is printed on it, its colour and its tilt follow from the seed."""
    return _scene(seed, np.inf)


def make_bar(seed: int) -> Scene:
    """Return a round bar, scanned along its axis; what is printed on it, its colour and its tilt follow from the seed."""
    return _scene(seed, _BAR_RADIUS)


def _scene(seed: int, radius: float) -> Scene:
    rng = np.random.default_rng([seed, 13])
    x = np.arange(-_MARGIN, _LENGTH + _MARGIN, _STEP)
    across = _HALF_WIDTH if np.isinf(radius) else np.pi * radius
    arc = np.linspace(-across, across, 2 * int(across / _STEP) + 1)
    grid_x, grid_arc = (values.ravel() for values in np.meshgrid(x, arc, indexing="ij"))
    # Rows run along x and columns around it: seen from outside, the grid's own order is clockwise.
    faces = grid_faces(len(x), len(arc))[:, ::-1].copy()
    mesh = make_mesh(_bend(grid_x, grid_arc, radius), faces, 0, -1, np.zeros((len(grid_x), 2)))
    for number, start in enumerate(np.arange(-_MARGIN, _LENGTH, _MARK_PITCH)):
        _mark(mesh, grid_x - start, grid_arc - rng.uniform(-0.006, 0.006), number % len(_MARKS))
    tilt = so3_exp(np.deg2rad([*(np.array(_TILT_DEG) + rng.normal(0, 0.7, 2)), 0.0]))
    lift = np.array([0.0, 0.0, 0.03])
    placed = Mesh(mesh.vertices @ tilt.T + lift, mesh.faces, mesh.material, mesh.tile, mesh.uv)
    path = ScanPath(lift, tilt[:, 0].copy(), tilt[:, 2].copy(), _LENGTH)
    material = Material(jitter((0.45, 0.44, 0.42), rng), jitter((0.33, 0.31, 0.28), rng), stain=0.4, speck_density=0.2)
    return Scene(placed, (material,), np.stack([print_tile(text, 0.85, (0.12, 0.62)) for text in _MARKS]), path)


def _bend(x: FloatArray, arc: FloatArray, radius: float) -> FloatArray:
    """Return points (N, 3) at ``x`` along and ``arc`` around a surface whose top is the x axis, up is z."""
    if np.isinf(radius):
        return np.stack([x, arc, np.zeros_like(x)], axis=1)
    return np.stack([x, radius * np.sin(arc / radius), radius * (np.cos(arc / radius) - 1)], axis=1)


def _mark(mesh: Mesh, x: FloatArray, arc: FloatArray, tile: int) -> None:
    """Print a tile on the faces whose vertices lie within it; ``x`` and ``arc`` (V,) are from its corner and its middle."""
    u, v = x / _MARK_SIZE, 0.5 - arc / _MARK_SIZE
    inside = (np.abs(u - 0.5) < 0.5) & (np.abs(v - 0.5) < 0.5)
    mesh.tile[inside[mesh.faces].all(axis=1)] = tile
    mesh.uv[inside] = np.stack([u, v], axis=1)[inside]
