"""A machined casting: bosses with bores, pads with engraved numbers, ribs and fins on a rough plate. Weak texture, some gloss."""

from __future__ import annotations

import cv2
import numpy as np

from vli_common.arrays import FloatArray
from vli_common.geometry import so3_exp
from vli_simulation.mesh import Mesh, grid_faces, make_mesh
from vli_simulation.motion import ScanPath
from vli_simulation.scenes.scene import Material, Scene, jitter, print_tile
from vli_simulation.texture import noise_field, noise_table

_LENGTH, _HALF_WIDTH = 0.40, 0.042
_STEP = 0.3e-3
_WALL = 0.9e-3
"""Run of a wall between two levels: castings have draft."""
_FILLET = 1.0e-3
_ENGRAVED = 0.35e-3
_TILT_DEG = (3.0, -4.0)
_CAST, _MACHINED = range(2)
_ROW = 0.046
"""Length of one group of features along the part."""


def make_part(seed: int) -> Scene:
    """Return a casting whose features and marks follow from the seed."""
    rng = np.random.default_rng([seed, 12])
    x = np.arange(-0.03, _LENGTH + 0.03, _STEP)
    y = np.arange(-_HALF_WIDTH, _HALF_WIDTH, _STEP)
    gx, gy = np.meshgrid(x, y, indexing="ij")
    relief = _Relief(gx, gy)
    makers = (_boss_group, _pad_group, _fin_group, _rib_group)
    for number, start in enumerate(np.arange(-0.03, _LENGTH + 0.03, _ROW)):
        makers[int(number + rng.integers(2)) % len(makers)](relief, start + 0.5 * _ROW, rng)
    mesh = _mesh(relief, seed)
    tilt = so3_exp(np.deg2rad([*(np.array(_TILT_DEG) + rng.normal(0, 0.7, 2)), 0.0]))
    lift = np.array([0.0, 0.0, 0.03])
    placed = Mesh(mesh.vertices @ tilt.T + lift, mesh.faces, mesh.material, mesh.tile, mesh.uv)
    path = ScanPath(tilt @ np.array([0.0, 0.0, 0.0035]) + lift, tilt[:, 0].copy(), tilt[:, 2].copy(), _LENGTH)
    return Scene(placed, _materials(rng), np.zeros((1, 8, 8), np.uint8), path)


def _materials(rng: np.random.Generator) -> tuple[Material, ...]:
    cast = Material(
        jitter((0.36, 0.36, 0.37), rng),
        jitter((0.29, 0.28, 0.27), rng),
        stain_cell=0.008,
        stain=0.45,
        grain_cell=0.9e-3,
        grain=0.085,
        speck_density=0.16,
        speck=0.4,
        gloss=0.10,
        shininess=18,
    )
    machined = Material(
        jitter((0.44, 0.44, 0.45), rng),
        jitter((0.38, 0.37, 0.36), rng),
        stain_cell=0.010,
        stain=0.35,
        grain_cell=0.5e-3,
        grain=0.045,
        stretch=5.0,
        speck_density=0.06,
        speck=0.25,
        gloss=0.20,
        shininess=35,
    )
    return cast, machined


class _Relief:
    """A height over a grid, built up feature by feature; ``machined`` marks the tops that a cutter has passed over."""

    def __init__(self, x: FloatArray, y: FloatArray) -> None:
        self.x, self.y = x, y
        self.height = np.zeros_like(x)
        self.machined = np.zeros_like(x, dtype=np.bool_)

    def raise_to(self, inside: FloatArray, level: float, machined: bool = True) -> None:
        """Raise the part to ``level`` where the signed distance ``inside`` is positive, with a fillet at the foot."""
        feature = level * _smooth_step(inside / _WALL + 0.5)
        overlap = np.clip(_FILLET - np.abs(feature - self.height), 0, None)
        self.height = np.maximum(self.height, feature) + np.where(feature > 1e-5, overlap**2 / (6 * _FILLET), 0.0) * (inside < 0)
        self.machined |= machined & (inside > 0.5 * _WALL)

    def sink_to(self, inside: FloatArray, level: float) -> None:
        """Cut down to ``level`` where ``inside`` is positive."""
        share = _smooth_step(inside / _WALL + 0.5)
        self.height = np.where(level < self.height, self.height + share * (level - self.height), self.height)
        self.machined &= inside < -0.3 * _WALL

    def disc(self, x: float, y: float, radius: float) -> FloatArray:
        """Return the signed distance into a disc."""
        return radius - np.hypot(self.x - x, self.y - y)

    def box(self, x: float, y: float, half_x: float, half_y: float, corner: float = 2e-3, turn: float = 0.0) -> FloatArray:
        """Return the signed distance into a rectangle with rounded corners, turned by ``turn`` radians."""
        c, s = np.cos(turn), np.sin(turn)
        u, v = c * (self.x - x) + s * (self.y - y), -s * (self.x - x) + c * (self.y - y)
        dx, dy = np.abs(u) - half_x + corner, np.abs(v) - half_y + corner
        result: FloatArray = corner - np.hypot(np.maximum(dx, 0), np.maximum(dy, 0)) - np.minimum(np.maximum(dx, dy), 0)
        return result

    def engrave(self, text: str, x: float, y: float, size: float) -> None:
        """Engrave ``text`` in a square of ``size`` metres centred at (x, y), upright along −x."""
        tile = cv2.GaussianBlur(print_tile(text, 0.85, (0.06, 0.66)), (0, 0), 2.0)
        u = (self.y - y) / size + 0.5
        v = (self.x - x) / size + 0.5
        at = [(np.clip(a, -0.5, 1.5) * tile.shape[0]).astype(np.float32) for a in (u, v)]
        cut = cv2.remap(
            tile.astype(np.float32) / 255, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0
        )
        self.height = self.height - _ENGRAVED * cut


def _boss_group(relief: _Relief, x: float, rng: np.random.Generator) -> None:
    """Two bosses with bores and a bolt circle on a common web."""
    relief.raise_to(relief.box(x, 0.0, 0.004, 0.030), 2.2e-3, machined=False)
    for y in (-0.015, 0.013):
        at = x + rng.normal(0, 1e-3), y + rng.normal(0, 1e-3)
        relief.raise_to(relief.disc(*at, 0.0105), rng.uniform(4.5e-3, 6.0e-3))
        relief.sink_to(relief.disc(*at, 0.0052), -2.5e-3)
        for angle in np.pi / 3 * np.arange(6) + rng.uniform(0, 1):
            relief.sink_to(relief.disc(at[0] + 0.0079 * np.cos(angle), at[1] + 0.0079 * np.sin(angle), 0.0011), 2.5e-3)


def _pad_group(relief: _Relief, x: float, rng: np.random.Generator) -> None:
    """A machined pad with an engraved number and two tapped holes, a smaller pad beside it."""
    level = rng.uniform(3.0e-3, 4.5e-3)
    relief.raise_to(relief.box(x, 0.006, 0.017, 0.014), level)
    relief.engrave("".join(str(digit) for digit in rng.integers(0, 10, 2)) + rng.choice(list("ABCDEF")), x, 0.007, 0.018)
    for side in (-1, 1):
        relief.sink_to(relief.disc(x + side * 0.0135, -0.004, 0.0017), -1e-3)
    relief.raise_to(relief.box(x + rng.normal(0, 2e-3), -0.020, 0.011, 0.007), level - 1.2e-3)
    relief.sink_to(relief.box(x, -0.020, 0.007, 0.0022), 0.4e-3)


def _fin_group(relief: _Relief, x: float, rng: np.random.Generator) -> None:
    """Slanted cooling fins."""
    turn = rng.uniform(-0.5, 0.5)
    for offset in np.arange(-0.014, 0.0141, 0.007):
        relief.raise_to(relief.box(x + offset, 0.0, 0.0014, 0.027, 1.2e-3, turn), rng.uniform(3.5e-3, 4.5e-3), machined=False)


def _rib_group(relief: _Relief, x: float, rng: np.random.Generator) -> None:
    """Crossing ribs around a round boss with a marked face."""
    for turn in (rng.uniform(0.5, 0.9), -rng.uniform(0.5, 0.9)):
        relief.raise_to(relief.box(x, 0.0, 0.024, 0.0017, 1.4e-3, turn), 4.0e-3, machined=False)
    relief.raise_to(relief.disc(x, 0.0, 0.0105), 5.2e-3)
    relief.engrave(f"R{rng.integers(1, 10)}", x + 0.001, 0.001, 0.014)
    relief.sink_to(relief.disc(x - 0.0065, 0.0, 0.0014), 1e-3)


def _mesh(relief: _Relief, seed: int) -> Mesh:
    """Return the grid as a mesh; cast skin is rough, machined faces are not."""
    rows, columns = relief.x.shape
    flat = np.stack([relief.x, relief.y, np.zeros_like(relief.x)], axis=-1).reshape(-1, 3)
    skin = noise_field(noise_table(seed + 2000), flat, 1.6e-3, 2, 0.5).reshape(rows, columns)
    height = relief.height + np.where(relief.machined, 2e-6, 2.2e-5) * skin
    faces = grid_faces(rows, columns)
    # Rows run along x and columns along y: seen from above, the grid's own order is clockwise.
    faces = faces[:, ::-1].copy()
    vertices = np.stack([relief.x, relief.y, height], axis=-1).reshape(-1, 3)
    mesh = make_mesh(vertices, faces, _CAST)
    mesh.material[relief.machined.ravel()[faces].all(axis=1)] = _MACHINED
    return mesh


def _smooth_step(x: FloatArray) -> FloatArray:
    x = np.clip(x, 0, 1)
    result: FloatArray = x * x * (3 - 2 * x)
    return result
