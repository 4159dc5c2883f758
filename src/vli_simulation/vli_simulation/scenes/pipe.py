"""The inside of a corroded steel pipe: weld beads around and along it, a ring of bolts, pits, stencilled marks."""

from __future__ import annotations

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.geometry import so3_exp
from vli_simulation.mesh import Mesh, grid_faces, join, loft, make_mesh
from vli_simulation.motion import ScanPath
from vli_simulation.scenes.scene import Material, Scene, jitter, print_tile
from vli_simulation.texture import noise_field, noise_table

_RADIUS = 0.055
_LENGTH = 0.42
_STEP = 0.6e-3
_FINE_HALF_ARC = 1.25
"""Radians on either side of the scanned line that are meshed finely; the rest of the pipe closes it."""
_BEAD_HEIGHT, _BEAD_SIGMA = 1.1e-3, 1.7e-3
_AXIS_TILT_DEG = 6.0
_SCAN_AZIMUTH_DEG = 35.0
_MARKS, _MARK_SIZE = ("W1", "DN", "110", "W2", "S4", "7B"), 0.018
_RUST, _WELD, _BOLT, _WASHER, _PAINT = range(5)


def make_pipe(seed: int) -> Scene:
    """Return a pipe whose welds, bolts and corrosion follow from the seed."""
    rng = np.random.default_rng([seed, 11])
    beads = np.array([0.07, 0.19, 0.31]) + rng.uniform(-0.015, 0.015, 3)
    wall = _Wall(noise_table(seed + 1000), beads, rng.uniform(0.010, 0.016) / _RADIUS * rng.choice([-1, 1]))
    bolts = [
        _bolt(wall, x + side * 0.011, arc + rng.normal(0, 0.01), rng)
        for x in (beads[0] + 0.05, beads[1] + 0.06)
        for side in (-1, 1)
        for arc in (-0.62, -0.2, 0.2, 0.62)
    ]
    shell = wall.mesh()
    tiles = np.stack([print_tile(text, 0.75, (0.16, 0.6)) for text in _MARKS])
    for index in range(len(_MARKS)):
        wall.paint(shell, index, beads[index % 3] + (0.016 if index < 3 else -0.034), rng.uniform(-0.2, 0.2))
    mesh = join([shell, *bolts])
    roll, tilt = np.deg2rad(_SCAN_AZIMUTH_DEG + rng.normal(0, 4)), np.deg2rad(_AXIS_TILT_DEG + rng.normal(0, 1))
    R_world_pipe = so3_exp(np.array([0.0, tilt, 0.0])) @ so3_exp(np.array([roll, 0.0, 0.0]))
    lift = np.array([0.0, 0.0, 0.12])
    start = np.array([0.03, 0.0, -_RADIUS + 0.001])
    path = ScanPath(R_world_pipe @ start + lift, R_world_pipe[:, 0].copy(), R_world_pipe[:, 2].copy(), _LENGTH - 0.06)
    placed = Mesh(mesh.vertices @ R_world_pipe.T + lift, mesh.faces, mesh.material, mesh.tile, mesh.uv)
    return Scene(placed, _materials(rng), tiles, path)


def _materials(rng: np.random.Generator) -> tuple[Material, ...]:
    steel = jitter((0.34, 0.30, 0.27), rng)
    rust = jitter((0.40, 0.21, 0.11), rng)
    return (
        Material(steel, rust, stain_cell=0.0065, stain=0.62, grain=0.17, speck_density=0.25, speck=0.5, gloss=0.05, shininess=25),
        Material(
            jitter((0.375, 0.35, 0.335), rng),
            jitter((0.33, 0.27, 0.30), rng),
            stain_cell=0.002,
            stain=0.5,
            grain=0.11,
            gloss=0.2,
            shininess=40,
        ),
        Material(jitter((0.46, 0.45, 0.43), rng), rust, stain_cell=0.003, stain=0.32, grain=0.09, gloss=0.15, shininess=40),
        Material(jitter((0.38, 0.37, 0.36), rng), rust, stain_cell=0.002, stain=0.45, grain=0.10, gloss=0.10, shininess=30),
        Material(
            steel,
            rust,
            ink=(0.62, 0.56, 0.22),
            stain_cell=0.0065,
            stain=0.62,
            grain=0.17,
            speck_density=0.25,
            speck=0.5,
            gloss=0.05,
        ),
    )


class _Wall:
    """The wall as a height towards the axis over (x, arc); arc is the azimuth from the scanned line, z down to it."""

    def __init__(self, table: np.ndarray[tuple[int, ...], np.dtype[np.float32]], beads: FloatArray, seam_arc: float) -> None:
        self._table, self._beads, self._seam = table, beads, seam_arc

    def weld(self, x: FloatArray, arc: FloatArray) -> FloatArray:
        """Return the height of weld beads, metres."""
        ground = self._noise(x, arc, 0.006, 1)
        height = np.zeros_like(x)
        for bead in self._beads:
            ripple = 1 + 0.16 * np.cos(2 * np.pi * (_RADIUS * arc + 4 * np.abs(x - bead)) / 2.1e-3) + 0.12 * ground
            height = np.maximum(height, _BEAD_HEIGHT * ripple * np.exp(-0.5 * ((x - bead + 2e-4 * ground) / _BEAD_SIGMA) ** 2))
        ripple = 1 + 0.14 * np.cos(2 * np.pi * (x + 4 * _RADIUS * np.abs(arc - self._seam)) / 1.9e-3) + 0.12 * ground
        seam = 0.8e-3 * ripple * np.exp(-0.5 * ((arc - self._seam) * _RADIUS / 1.4e-3) ** 2)
        result: FloatArray = np.maximum(height, seam)
        return result

    def bright(self, x: FloatArray, arc: FloatArray) -> FloatArray:
        """Return 1 on the beads and where their heat has bared the metal, else 0; the border is ragged."""
        ragged = 0.35e-3 * self._noise(x + 0.3, arc, 0.0016, 2)
        across = np.minimum(np.abs(x[:, None] - self._beads).min(axis=1), np.abs(arc - self._seam) * _RADIUS + 0.5e-3)
        result: FloatArray = (across + ragged < 2.7e-3).astype(np.float64)
        return result

    def height(self, x: FloatArray, arc: FloatArray) -> FloatArray:
        """Return the relief towards the axis, metres: out-of-round, corrosion, pits, welds."""
        rough = 1.1e-4 * self._noise(x, arc, 0.009, 3)
        pits = -5e-4 * np.clip(self._noise(x + 0.7, arc, 0.0035, 1) - 1.35, 0, 1)
        return rough + pits + self.weld(x, arc) + 4e-4 * np.sin(3 * arc + 17 * x)

    def place(self, x: FloatArray, arc: FloatArray) -> FloatArray:
        """Return points (N, 3) of the wall in the pipe's frame."""
        radius = _RADIUS - self.height(x, arc)
        return np.stack([x, radius * np.sin(arc), -radius * np.cos(arc)], axis=1)

    def mesh(self) -> Mesh:
        """Return the whole wall."""
        x = np.arange(-0.03, _LENGTH + 0.03, _STEP)
        fine = np.arange(-_FINE_HALF_ARC, _FINE_HALF_ARC, _STEP / _RADIUS)
        coarse = np.arange(_FINE_HALF_ARC, 2 * np.pi - _FINE_HALF_ARC, 0.05)
        gx, ga = np.meshgrid(x, np.concatenate([fine, coarse]), indexing="ij")
        flat_x, flat_arc = gx.ravel(), ga.ravel()
        faces = grid_faces(gx.shape[0], gx.shape[1], closed=True)[:, ::-1].copy()
        mesh = make_mesh(self.place(flat_x, flat_arc), faces, _RUST)
        mesh.material[self.bright(flat_x, flat_arc)[faces].mean(axis=1) > 0.5] = _WELD
        return mesh

    def paint(self, shell: Mesh, tile: int, x: float, arc: float) -> None:
        """Stencil a tile on the bare wall, from x and around ``arc``; changes ``shell``, which :meth:`mesh` made."""
        vertices = shell.vertices
        u = (vertices[:, 0] - x) / _MARK_SIZE
        v = 0.5 - (np.arctan2(vertices[:, 1], -vertices[:, 2]) - arc) * _RADIUS / _MARK_SIZE
        inside = (np.abs(u - 0.5) < 0.5) & (np.abs(v - 0.5) < 0.5)
        faces = inside[shell.faces].all(axis=1) & (shell.material == _RUST)
        shell.material[faces], shell.tile[faces] = _PAINT, tile
        shell.uv[inside] = np.stack([u, v], axis=1)[inside]

    def _noise(self, x: FloatArray, arc: FloatArray, cell: float, octaves: int) -> FloatArray:
        points = np.stack([x, _RADIUS * np.sin(arc), _RADIUS * np.cos(arc)], axis=1)
        result: FloatArray = noise_field(self._table, points, cell, octaves, 0.5)
        return result


def _bolt(wall: _Wall, x: float, arc: float, rng: np.random.Generator) -> Mesh:
    """Return a hexagon bolt on a washer, seen from its head."""
    turn = rng.uniform(0, np.pi)
    angle = 2 * np.pi * np.arange(48) / 48
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    folded = np.mod(angle - turn, np.pi / 3) - np.pi / 6
    hexagon = circle / np.cos(folded)[:, None]
    washer = _rings(circle, ((5.6e-3, -1e-3), (5.6e-3, 0.8e-3), (5.3e-3, 1.05e-3), (3.0e-3, 1.05e-3)))
    round_off = hexagon * 4.0e-3
    trimmed = round_off * np.minimum(1.0, 4.35e-3 / np.linalg.norm(round_off, axis=1, keepdims=True))
    head = [np.column_stack([round_off, np.full(48, z)]) for z in (0.9e-3, 3.6e-3)]
    head += [
        np.column_stack([trimmed * s, np.full(48, z)])
        for s, z in ((0.985, 4.1e-3), (0.93, 4.35e-3), (0.7, 4.45e-3), (0.35, 4.42e-3))
    ]
    parts = []
    for rings, top, material in ((washer, 1.05e-3, _WASHER), (head, 4.4e-3, _BOLT)):
        vertices, faces = loft(rings, np.array([0.0, 0.0, top]))
        parts.append(make_mesh(_on_wall(vertices, x, arc), faces, material))
    return join(parts)


def _rings(outline: FloatArray, profile: tuple[tuple[float, float], ...]) -> list[FloatArray]:
    return [np.column_stack([outline * scale, np.full(len(outline), z)]) for scale, z in profile]


def _on_wall(vertices: FloatArray, x: float, arc: float) -> FloatArray:
    """Return local vertices (x along the pipe, y around, z towards the axis) in the pipe's frame."""
    axes = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(arc), np.sin(arc)], [0.0, -np.sin(arc), np.cos(arc)]])
    origin = np.array([x, _RADIUS * np.sin(arc), -_RADIUS * np.cos(arc)])
    result: FloatArray = vertices @ axes + origin
    return result
