"""A full-size keyboard: sculpted caps at 19.05 mm pitch with legends, on a tilted case."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.geometry import so3_exp
from vli_simulation.mesh import Mesh, grid_faces, join, loft, make_mesh, rounded_rectangle
from vli_simulation.motion import ScanPath
from vli_simulation.scenes.scene import Material, Scene, jitter, print_tile

PITCH = 0.01905
_GAP = 0.0008
_ROWS: tuple[str, ...] = (
    "Esc _1 F1 F2 F3 F4 _.5 F5 F6 F7 F8 _.5 F9 F10 F11 F12 _.25 Prt Scr Brk",
    "~` !1 @2 #3 $4 %5 ^6 &7 *8 (9 )0 -_ += Back:2 _.25 Ins Home PgU _.25 Num / * -",
    "Tab:1.5 Q W E R T Y U I O P [{ ]} |:1.5 _.25 Del End PgD _.25 7 8 9 +",
    "Caps:1.75 A S D F G H J K L ;: '\" Enter:2.25 _3.5 4 5 6 +",
    "Shift:2.25 Z X C V B N M <, >. ?/ Shift:2.75 _1.25 Up _1.25 1 2 3 Ent",
    "Ctrl:1.25 Win:1.25 Alt:1.25 Space:6.25 Alt:1.25 Win:1.25 Menu:1.25 Ctrl:1.25 _.25 Lt Dn Rt _.25 0:2 . Ent",
)
_ROW_HEIGHT = (0.0098, 0.0098, 0.0086, 0.0080, 0.0086, 0.0092)
_ROW_TILT_DEG = (9.0, 8.0, 4.0, 0.0, -5.0, -7.0)
_CORNER, _FILLET, _DISH = 0.0022, 0.0011, 0.0007
_CASE_TILT_DEG = (4.0, 1.5)


@dataclass(frozen=True)
class _Key:
    label: str
    row: int
    centre: tuple[float, float]
    units: float


def make_keyboard(seed: int) -> Scene:
    """Return a keyboard whose colours, heights and wear follow from the seed."""
    rng = np.random.default_rng([seed, 10])
    materials = _materials(rng)
    keys = list(_layout())
    tiles = np.stack([_legend(key) for key in keys])
    caps = [_cap(key, index, int(_cap_material(key, rng)), rng) for index, key in enumerate(keys)]
    width = max(key.centre[0] for key in keys) + PITCH
    mesh = join([*caps, _deck(width)])
    tilt = so3_exp(np.deg2rad([_CASE_TILT_DEG[0] + rng.normal(0, 0.5), _CASE_TILT_DEG[1] + rng.normal(0, 0.5), 0.0]))
    lift = np.array([0.0, 0.0, 0.02])
    start = np.array([0.036, -3.0 * PITCH, _ROW_HEIGHT[3] - 0.0005])
    path = ScanPath(tilt @ start + lift, tilt @ np.array([1.0, 0.0, 0.0]), tilt @ np.array([0.0, 0.0, 1.0]), width - 0.072)
    placed = Mesh(mesh.vertices @ tilt.T + lift, mesh.faces, mesh.material, mesh.tile, mesh.uv)
    return Scene(placed, materials, tiles, path)


def _materials(rng: np.random.Generator) -> tuple[Material, ...]:
    light, dark, accent = (0.60, 0.57, 0.50), (0.25, 0.28, 0.32), (0.62, 0.26, 0.10)

    def worn(clean: tuple[float, float, float], dirty: tuple[float, float, float], ink: tuple[float, float, float]) -> Material:
        return Material(jitter(clean, rng), jitter(dirty, rng), ink=ink, stain_cell=0.005, stain=0.35, grain=0.085)

    caps = [worn(light, (0.50, 0.45, 0.36), (0.03, 0.03, 0.03)) for _ in range(5)]
    modifiers = [worn(dark, (0.30, 0.30, 0.30), (0.62, 0.62, 0.60)) for _ in range(4)]
    accents = [worn(accent, (0.50, 0.28, 0.16), (0.70, 0.68, 0.62))]
    deck = Material((0.13, 0.125, 0.12), (0.22, 0.20, 0.17), stain=0.45, grain=0.16, speck_density=0.3, speck=0.9)
    return (*caps, *modifiers, *accents, deck)


def _layout() -> Iterator[_Key]:
    for row, line in enumerate(_ROWS):
        at = 0.0
        y = -row * PITCH - (0.25 * PITCH if row else 0.0)
        for token in line.split():
            if token.startswith("_"):
                at += float(token[1:])
                continue
            label, _, units = token.partition(":") if len(token) > 2 else (token, "", "")
            size = float(units or 1.0)
            yield _Key(label, row, ((at + 0.5 * size) * PITCH, y), size)
            at += size


def _cap_material(key: _Key, rng: np.random.Generator) -> int:
    if key.label in ("Esc", "Enter"):
        return 9
    modifier = len(key.label) > 2 or key.units > 1.0 or key.label in ("Up", "Lt", "Dn", "Rt")
    if modifier and key.label != "Space" and not key.label.startswith("F"):
        return 5 + int(rng.integers(4))
    return int(rng.integers(5))


def _legend(key: _Key) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    if key.label == "Space":
        return print_tile("")
    if len(key.label) == 1:
        return print_tile(key.label, 0.95, (0.2, 0.52))
    if len(key.label) == 2 and not key.label.isalnum():
        return print_tile(key.label[1], 0.75, (0.22, 0.74), key.label[0])
    return print_tile(key.label, 0.58 if len(key.label) < 4 else 0.46, (0.1, 0.42))


def _cap(key: _Key, tile: int, material: int, rng: np.random.Generator) -> Mesh:
    """Return one cap: flanks that lean in, a rounded edge, a dished top that is tilted by row."""
    half_x, half_y = 0.5 * key.units * PITCH - 0.5 * _GAP, 0.5 * PITCH - 0.5 * _GAP
    top_x, top_y = half_x - 0.0026, half_y - 0.0024
    height = _ROW_HEIGHT[key.row] + rng.normal(0, 0.00012)
    rings = []
    for share in np.linspace(0.0, 1.0, 7):
        outline = rounded_rectangle(
            half_x + share * (top_x - half_x), half_y + share * (top_y - half_y), 0.0012 + share * (_CORNER - 0.0012)
        )
        rings.append(_ring(outline, -0.002 + share * (height - _FILLET + 0.002)))
    for angle in np.linspace(0.0, np.pi / 2, 7)[1:]:
        inset = _FILLET * (1 - np.cos(angle))
        rings.append(
            _ring(rounded_rectangle(top_x - inset, top_y - inset, _CORNER - 0.6 * inset), height - _FILLET * (1 - np.sin(angle)))
        )
    inner_x, inner_y = top_x - _FILLET, top_y - _FILLET
    for scale in np.linspace(1.0, 0.0, 14)[1:-1]:
        outline = rounded_rectangle(inner_x, inner_y, _CORNER - 0.6 * _FILLET) * scale
        rings.append(_ring(outline, height - _dish(outline, inner_x)))
    apex = np.array([0.0, 0.0, height - _dish(np.zeros((1, 2)), inner_x)[0]])
    vertices, faces = loft(rings, apex)
    uv = np.stack([0.5 + vertices[:, 0] / (2 * inner_y), 0.5 - vertices[:, 1] / (2 * inner_y)], axis=1)
    uv[:, 0] += 0.5 * (inner_x - inner_y) / inner_y
    share = np.clip(vertices[:, 2] / height, 0, 1)
    vertices[:, 2] += share * np.tan(np.deg2rad(_ROW_TILT_DEG[key.row] + rng.normal(0, 0.4))) * vertices[:, 1]
    vertices[:, 2] += share * np.tan(np.deg2rad(rng.normal(0, 0.5))) * vertices[:, 0] / max(key.units, 1.0)
    vertices[:, :2] += key.centre
    return make_mesh(vertices, faces, material, tile, uv)


def _ring(outline: FloatArray, height: FloatArray | float) -> FloatArray:
    return np.column_stack([outline, np.broadcast_to(height, len(outline))])


def _dish(outline: FloatArray, inner_x: float) -> FloatArray:
    """Return the depth of a cylindrical dish with soft rims at outline points (K, 2)."""
    result: FloatArray = _DISH * (1 - np.clip(np.abs(outline[:, 0]) / inner_x, 0, 1) ** 2.5)
    return result


def _deck(width: float) -> Mesh:
    """Return the case below the caps, with a raised frame around them."""
    x = np.arange(-0.02, width + 0.02, 0.0015)
    y = np.arange(0.028, -6.25 * PITCH - 0.018, -0.0015)
    gx, gy = np.meshgrid(x, y)
    outside = np.maximum(
        np.maximum(-0.0025 - gx, gx - (width - 0.5 * PITCH + 0.0045)), np.maximum(gy - 0.0115, -5.25 * PITCH - 0.0115 - gy)
    )
    z = -0.0015 + 0.007 / (1 + np.exp(-(outside - 0.0015) / 0.0006))
    faces = grid_faces(len(y), len(x))[:, ::-1]
    return make_mesh(np.stack([gx, gy, z], axis=-1).reshape(-1, 3), np.ascontiguousarray(faces), 10)
