"""What a scene is: one mesh, its materials and prints, and where it wants to be scanned."""

from __future__ import annotations

from dataclasses import dataclass, fields

import cv2
import numpy as np

from vli_common.arrays import ByteArray, FloatArray
from vli_simulation.mesh import Mesh
from vli_simulation.motion import ScanPath

TILE_PX = 224


@dataclass(frozen=True)
class Material:
    """Look of a surface; albedos are linear, order red, green, blue, 0 to 1.

    Args:
        albedo: of the clean surface.
        stained: albedo of stains, rust or wear; mixed in where coarse noise is high.
        ink: albedo of what is printed on it.
        stain_cell: size of stains, metres.
        stain: how much is stained, 0 to 1; the noise threshold.
        grain_cell: coarsest cell of the grain, metres; finer octaves follow.
        grain: relative amplitude of the grain.
        persistence: amplitude of an octave over that of the coarser one.
        stretch: length of the grain over its width, along the world's x (brushed or turned metal).
        speck_cell: spacing of grains of dirt, metres.
        speck_density: share of cells that hold one.
        speck: relative brightness of one.
        gloss: strength of the highlight, relative to the diffuse term of a white surface.
        shininess: Blinn–Phong exponent.
    """

    albedo: tuple[float, float, float]
    stained: tuple[float, float, float]
    ink: tuple[float, float, float] = (0.03, 0.03, 0.03)
    stain_cell: float = 0.006
    stain: float = 0.3
    grain_cell: float = 0.0011
    grain: float = 0.10
    persistence: float = 0.8
    stretch: float = 1.0
    speck_cell: float = 0.0012
    speck_density: float = 0.12
    speck: float = 0.35
    gloss: float = 0.03
    shininess: float = 20.0

    def row(self) -> list[float]:
        """Return all numbers in the order of the fields: nine albedo values, then the scalars."""
        values = [getattr(self, item.name) for item in fields(self)]
        return [*values[0], *values[1], *values[2], *values[3:]]


@dataclass(frozen=True)
class Scene:
    """A surface in the gravity-aligned world.

    Args:
        mesh: the surface.
        materials: what ``mesh.material`` indexes.
        tiles: (T, H, W) uint8, coverage by ink.
        path: where to scan.
    """

    mesh: Mesh
    materials: tuple[Material, ...]
    tiles: ByteArray
    path: ScanPath


def print_tile(text: str, scale: float = 1.0, origin: tuple[float, float] = (0.12, 0.55), second: str = "") -> ByteArray:
    """Return a tile (TILE_PX, TILE_PX) with one or two lines of text, slightly blurred as ink is.

    Args:
        text: what is printed.
        scale: of the letters; 1 is a third of the tile.
        origin: lower left corner of the text as a share of the tile.
        second: a second, smaller line above.
    """
    tile = np.zeros((TILE_PX, TILE_PX), np.uint8)
    thickness = max(2, round(7 * scale))
    at = (round(origin[0] * TILE_PX), round(origin[1] * TILE_PX))
    cv2.putText(tile, text, at, cv2.FONT_HERSHEY_SIMPLEX, 2.6 * scale, 255, thickness, cv2.LINE_AA)
    if second:
        cv2.putText(
            tile, second, (at[0], round(0.32 * TILE_PX)), cv2.FONT_HERSHEY_SIMPLEX, 1.7 * scale, 255, thickness - 1, cv2.LINE_AA
        )
    blurred: ByteArray = cv2.GaussianBlur(tile, (0, 0), 1.0).astype(np.uint8)
    return blurred


def jitter(colour: tuple[float, float, float], rng: np.random.Generator, amount: float = 0.06) -> tuple[float, float, float]:
    """Return a colour that differs a little, as parts of one batch do."""
    value: FloatArray = np.clip(
        np.array(colour) * (1 + amount * rng.standard_normal()) * (1 + 0.3 * amount * rng.standard_normal(3)), 0, 1
    )
    return float(value[0]), float(value[1]), float(value[2])
