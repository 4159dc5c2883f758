"""What the camera sees of a board: the sensor model of the scenes, on a surface known in closed form.

Edges of the print are averaged over each pixel's area, so that a corner appears where it projects to, to hundredths of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vli_common.arrays import Float32Array, FloatArray, IntArray
from vli_common.geometry import transform
from vli_simulation import gbuffer, shading
from vli_simulation.board import surface as plate
from vli_simulation.board.surface import PAPER, BoardSurface
from vli_simulation.config import SimulationConfig
from vli_simulation.gbuffer import GBuffer
from vli_simulation.optics import DIM_STEP, Lens
from vli_simulation.render import (
    DIVERGENCE,
    GREY_OF_WHITE,
    NOMINAL_LONG_S,
    NOMINAL_SHORT_S,
    STRIPE_OF_WHITE,
    WAIST,
    Memory,
    View,
    add_speckle,
    grain_kernel,
)
from vli_simulation.rig import Rig
from vli_simulation.texture import noise_table

_SAMPLES, _EDGE_SAMPLES = 8, 32
"""Rays a pixel: for the laser and the plate's edge, and where an edge of the print crosses it."""
_SPREAD_PX = 2
"""The sheet's light is looked for so far around pixels whose middle it reaches."""


@dataclass(frozen=True)
class Exposures:
    """Seconds of the long and of the short exposure."""

    long_s: float
    short_s: float


class _Grid:
    """Rays (N, 3) of unit depth through the middle of cells, and how they change over one cell (N, 4)."""

    def __init__(self, rig: Rig, pixels: FloatArray, shape: tuple[int, int], step: float) -> None:
        unproject, half = rig.camera.unproject, 0.5 * step
        self.shape = shape
        self.rays: Float32Array = np.column_stack([unproject(pixels), np.ones(len(pixels))]).astype(np.float32)
        across = unproject(pixels + np.array([half, 0.0])) - unproject(pixels - np.array([half, 0.0]))
        down = unproject(pixels + np.array([0.0, half])) - unproject(pixels - np.array([0.0, half]))
        self.spans: Float32Array = np.hstack([across, down]).astype(np.float32)


class BoardRenderer:
    """Renders a board as a rig sees it; views are in the board's frame. Threads may use one renderer together."""

    def __init__(self, surface: BoardSurface, rig: Rig, config: SimulationConfig, seed: int) -> None:
        self._surface, self._rig, self._config = surface, rig, config
        self._nominal = config.motion.distance
        self._table = noise_table(seed)
        self._lens = Lens(rig.camera, config.sensor.vignetting)
        self._full = self._make_grid((rig.camera.height, rig.camera.width), 1.0)
        self._dim = self._make_grid(self._lens.dim_shape, DIM_STEP)
        self._offsets, self._edge_offsets = _lattice(_SAMPLES, 3), _lattice(_EDGE_SAMPLES, 7)
        self._grain = grain_kernel(np.deg2rad(config.rig.stripe_angle_deg))
        self._memory = Memory()

    def long_light(self, view: View, exposure_s: float) -> Float32Array:
        """Return an exposure with the laser off as light on an RGGB mosaic (H, W), in grey levels before noise; read only."""
        return self._memory.recall(f"long {exposure_s}", view, lambda view: self._expose(view, self._full, exposure_s))

    def short_light(self, view: View, exposure_s: float, rng: np.random.Generator, coarse: bool = False) -> Float32Array:
        """Return an exposure with the laser on, as :meth:`long_light`.

        Args:
            view: of the camera.
            exposure_s: of the shutter.
            rng: draws the speckle.
            coarse: render what the LED lights at a third of the resolution: hardly seen above the noise, and faster.
        """
        grid = self._dim if coarse else self._full
        image = self._memory.recall(f"dim {exposure_s}", view, lambda view: self._expose(view, grid, exposure_s)).copy()
        self._add_stripe(image, view, STRIPE_OF_WHITE * exposure_s / NOMINAL_SHORT_S, rng)
        return image

    def combined_light(self, view: View, exposures: Exposures, rng: np.random.Generator) -> Float32Array:
        """Return a long exposure with the laser turned down so far that its stripe is as bright as in a short one."""
        image = self.long_light(view, exposures.long_s).copy()
        self._add_stripe(image, view, STRIPE_OF_WHITE * exposures.short_s / NOMINAL_SHORT_S, rng)
        return image

    def brightness(self, view: View) -> tuple[float, float]:
        """Return grey levels, at nominal exposures, of white paper (95th percentile) and of the brightest stripe on it."""
        buffer = self._look(view, self._dim.rays)
        paper = np.flatnonzero(buffer.material == PAPER)
        if not len(paper):
            return 0.0, 0.0
        shown = buffer.at(paper)
        radiance = self._radiance(view, shown, self._albedo(shown))
        stripe = self._memory.recall("sheet", view, self._sheet)
        albedo = float(self._surface.materials[PAPER, :3].mean())
        return GREY_OF_WHITE * float(np.quantile(radiance[:, 1], 0.95)), STRIPE_OF_WHITE * albedo * float(stripe.max())

    def _make_grid(self, shape: tuple[int, int], step: float) -> _Grid:
        u, v = np.meshgrid(step * np.arange(shape[1]), step * np.arange(shape[0]))
        return _Grid(self._rig, np.stack([u, v], axis=-1).reshape(-1, 2), shape, step)

    def _expose(self, view: View, grid: _Grid, exposure_s: float) -> Float32Array:
        radiance, depth = self._memory.recall(f"radiance {len(grid.rays)}", view, lambda view: self._lit_view(view, grid))
        gain = GREY_OF_WHITE * exposure_s / NOMINAL_LONG_S
        return self._lens.expose(radiance, depth, view.velocity, view.rate, exposure_s, gain)

    def _lit_view(self, view: View, grid: _Grid) -> tuple[Float32Array, Float32Array]:
        """Return (radiance (H, W, 3), depth (H, W)) at full resolution."""
        buffer = self._look(view, grid.rays)
        albedo = self._albedo(buffer)
        self._print(view, grid.rays, buffer, albedo, grid.spans)
        radiance = self._radiance(view, buffer, albedo)
        if grid is self._full:
            self._soften_outline(view, buffer, radiance)
        shape = grid.shape
        radiance, depth = radiance.reshape(*shape, 3), buffer.depth.reshape(shape)
        return (radiance, depth) if grid is self._full else (self._lens.enlarge(radiance), self._lens.enlarge(depth))

    def _soften_outline(self, view: View, buffer: GBuffer, radiance: Float32Array) -> None:
        """Average pixels that the edge of the plate or of its shadow crosses over their area."""
        height, width = self._full.shape
        kind = (2 * buffer.material.astype(np.int16) + buffer.lit).reshape(height, width).astype(np.uint8)
        kernel = np.ones((3, 3), np.uint8)
        where = np.flatnonzero(np.asarray(cv2.morphologyEx(kind, cv2.MORPH_GRADIENT, kernel)))
        if not len(where):
            return
        rays = self._subrays(where)
        samples = self._look(view, rays)
        albedo = self._albedo(samples)
        self._print(view, rays, samples, albedo)
        radiance[where] = self._radiance(view, samples, albedo).reshape(_SAMPLES, len(where), 3).mean(axis=0)

    def _add_stripe(self, image: Float32Array, view: View, gain: float, rng: np.random.Generator) -> None:
        stripe = self._memory.recall("stripe", view, self._stripe).copy()
        add_speckle(stripe, self._grain, self._config.sensor.speckle, rng)
        self._lens.add_laser(stripe, self._rig.laser.response, gain, image)

    def _stripe(self, view: View) -> Float32Array:
        """Return the light of the laser on the surface (H, W), 1 on white at the nominal distance."""
        stripe = np.zeros(len(self._full.rays), np.float32)
        where = self._band(view)
        if len(where):
            rays = self._subrays(where)
            samples = self._look(view, rays)
            light = self._irradiance(view, samples)
            cut = np.flatnonzero(light > 0)
            kept = samples.at(cut)
            albedo = self._albedo(kept)
            self._print(view, np.ascontiguousarray(rays[cut]), kept, albedo)
            response = self._rig.laser.response / self._rig.laser.response.sum()
            light[cut] *= (albedo @ response).astype(np.float32)
            stripe[where] = light.reshape(_SAMPLES, -1).mean(axis=0)
        return stripe.reshape(self._full.shape)

    def _band(self, view: View) -> IntArray:
        """Return the pixels (flat index) that the sheet may reach."""
        lit = self._memory.recall("sheet", view, self._sheet) > 0
        size = 2 * _SPREAD_PX + 1
        return np.flatnonzero(np.asarray(cv2.dilate(lit.astype(np.uint8), np.ones((size, size), np.uint8))))

    def _sheet(self, view: View) -> Float32Array:
        """Return the laser's irradiance (H, W) in the middle of each pixel."""
        return self._irradiance(view, self._look(view, self._full.rays)).reshape(self._full.shape)

    def _irradiance(self, view: View, buffer: GBuffer) -> Float32Array:
        """Return the laser's irradiance (N,), zero where the plate hides the laser."""
        laser = self._rig.laser
        origin = transform(view.T_world_cam, laser.origin[None])[0]
        normal = view.T_world_cam[:3, :3] @ laser.normal
        out = np.empty(len(buffer.depth), np.float32)
        sheet = np.array([*normal, -float(normal @ origin)])
        shading.sheet_irradiance(buffer, origin, sheet, WAIST, DIVERGENCE, self._nominal, out)
        plate.hide(origin, buffer, self._surface.outline, out)
        return out

    def _subrays(self, where: IntArray) -> Float32Array:
        """Return the rays (K · n, 3) of K samples in each of n pixels, sample by sample."""
        rays = np.tile(self._full.rays[where], (_SAMPLES, 1, 1))
        spans, offsets = self._full.spans[where], self._offsets.astype(np.float32)
        rays[..., :2] += offsets[:, None, :1] * spans[None, :, :2] + offsets[:, None, 1:] * spans[None, :, 2:]
        return rays.reshape(-1, 3)

    def _look(self, view: View, rays: Float32Array) -> GBuffer:
        directions, out = np.empty_like(rays), GBuffer.empty(len(rays))
        gbuffer.turn(np.ascontiguousarray(view.T_world_cam[:3, :3]), rays, directions)
        light = transform(view.T_world_cam, self._rig.light[None])[0]
        eye = np.ascontiguousarray(view.eye)
        plate.look(eye, directions, self._surface.outline, self._surface.thickness, light, out)
        return out

    def _albedo(self, buffer: GBuffer) -> Float32Array:
        """Return the albedo (N, 3) of paper and table, without the print."""
        albedo = np.empty((len(buffer.depth), 3), np.float32)
        focal = self._rig.camera.focal_px
        shading.surface_albedo(buffer, focal, self._surface.materials, _NO_TILES, self._table, albedo)
        return albedo

    def _print(
        self, view: View, rays: Float32Array, buffer: GBuffer, albedo: Float32Array, spans: Float32Array | None = None
    ) -> None:
        """Lay the print over the albedo (N, 3) of what lies along rays (N, 3); with ``spans``, averaged over each ray's pixel."""
        offsets = self._edge_offsets if spans is not None else _NO_OFFSETS
        spans = _NO_SPANS if spans is None else spans
        ink, board = np.empty(len(rays), np.float32), self._surface
        eye, rotation = np.ascontiguousarray(view.eye), np.ascontiguousarray(view.T_world_cam[:3, :3])
        plate.ink_share(eye, rotation, rays, spans, offsets, buffer.material, board.ink, board.origin, board.scale, ink)
        albedo += ink[:, None] * (board.ink_albedo - albedo)

    def _radiance(self, view: View, buffer: GBuffer, albedo: Float32Array) -> Float32Array:
        radiance = np.empty_like(albedo)
        light = transform(view.T_world_cam, self._rig.light[None])[0]
        axis, eye = np.ascontiguousarray(view.T_world_cam[:3, 2]), np.ascontiguousarray(view.eye)
        shading.illuminate(buffer, albedo, self._surface.materials, eye, light, axis, self._nominal, radiance)
        return radiance


_NO_OFFSETS, _NO_SPANS = np.zeros((0, 2)), np.zeros((0, 4), np.float32)
_NO_TILES = np.zeros((1, 2, 2), np.uint8)


def _lattice(count: int, generator: int) -> FloatArray:
    """Return a Korobov lattice (count, 2) in a pixel, centred: even along both axes, and along most other directions."""
    index = np.arange(count)
    result: FloatArray = (np.stack([index, generator * index % count], axis=1) + 0.5) / count - 0.5
    return result
