"""One frame: what the camera sees at the middle of an exposure, lit by its own LED or cut by the laser."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import cv2
import numpy as np

from vli_common.arrays import BoolArray, Float32Array, FloatArray, IntArray
from vli_common.geometry import inverse, transform
from vli_simulation import gbuffer, shading
from vli_simulation.caster import RayCaster
from vli_simulation.config import SimulationConfig
from vli_simulation.gbuffer import GBuffer, Surface
from vli_simulation.optics import SUBPIXELS, Lens
from vli_simulation.rig import Rig
from vli_simulation.scenes.scene import Scene
from vli_simulation.texture import noise_table

T = TypeVar("T")

GREY_OF_WHITE = 330.0
"""Grey level of a white surface that faces the light at the nominal distance, in the nominal long exposure."""
NOMINAL_LONG_S, NOMINAL_SHORT_S = 0.005, 0.0004
"""Exposures that the grey levels here are stated for."""
STRIPE_OF_WHITE = 900.0
"""Grey level in the middle of the stripe on white, nominal short exposure: white saturates three and a half times."""
WAIST, DIVERGENCE = 0.8e-4, 1.4e-3
"""Of the laser's sheet: sigma in metres where it leaves the laser, and its growth per metre."""
_FAN_RAYS = 1600
_VISIBLE_GREY = 12.0


@dataclass(frozen=True)
class View:
    """A camera's state at mid-exposure: pose (4, 4), velocity and angular velocity (3,) in the camera frame."""

    T_world_cam: FloatArray
    velocity: FloatArray
    rate: FloatArray

    @property
    def eye(self) -> FloatArray:
        """Centre of the camera (3,) in the world."""
        return self.T_world_cam[:3, 3]


class Memory:
    """The newest results of a computation that depends on the view alone: a camera at rest is rendered once.

    Threads may compute the same view twice; the results are equal. They are shared, so nobody may write to them.
    """

    _SIZE = 12

    def __init__(self) -> None:
        self._results: dict[tuple[str, bytes], Any] = {}
        self._lock = threading.Lock()

    def recall(self, what: str, view: View, compute: Callable[[View], T]) -> T:
        """Return ``compute(view)``, from memory where it is there."""
        key = (what, b"".join((values + 0.0).tobytes() for values in (view.T_world_cam, view.velocity, view.rate)))
        with self._lock:
            if key in self._results:
                return cast(T, self._results[key])
        result = compute(view)
        with self._lock:
            while len(self._results) >= self._SIZE:
                del self._results[next(iter(self._results))]
            self._results[key] = result
        return result


@dataclass(frozen=True)
class SeenPoints:
    """What the laser lights and the camera sees.

    Args:
        points: (N, 3) in the world, exact: cast from the laser within its plane.
        light: (N, 3) grey levels of a long exposure without noise, blue green red.
        albedo: (N, 3), 0 to 1, blue green red.
    """

    points: FloatArray
    light: FloatArray
    albedo: FloatArray


class Renderer:
    """Renders a scene as a rig sees it; threads may use one renderer together."""

    def __init__(self, scene: Scene, rig: Rig, config: SimulationConfig, seed: int) -> None:
        self.caster = RayCaster(scene.mesh)
        self._rig, self._config = rig, config
        self._nominal = config.motion.distance
        self._materials = np.array([material.row() for material in scene.materials])
        self._surface = Surface(
            self.caster.faces,
            self.caster.normals,
            scene.mesh.material.astype(np.uint8),
            scene.mesh.tile.astype(np.int32),
            np.ascontiguousarray(scene.mesh.uv, dtype=np.float32),
        )
        self._tiles = scene.tiles
        self._table = noise_table(seed)
        self._lens = Lens(rig.camera, config.sensor.vignetting)
        self._grain = grain_kernel(np.deg2rad(config.rig.stripe_angle_deg))
        self._memory = Memory()

    def long_frame(self, view: View) -> Float32Array:
        """Return the long exposure as light on an RGGB mosaic (H, W), in grey levels before sensor noise; read only."""
        return self._memory.recall("long", view, self._long_frame)

    def _long_frame(self, view: View) -> Float32Array:
        radiance, depth = self._full_view(view)
        exposure = self._config.sensor.exposure_long_s
        return self._lens.expose(radiance, depth, view.velocity, view.rate, exposure, GREY_OF_WHITE * exposure / NOMINAL_LONG_S)

    def short_frame(self, view: View, rng: np.random.Generator) -> Float32Array:
        """Return the short exposure with the laser on, as :meth:`long_frame`; ``rng`` draws the speckle."""
        gain = STRIPE_OF_WHITE * self._config.sensor.exposure_short_s / NOMINAL_SHORT_S
        image = self._memory.recall("dim", view, self._dim_frame).copy()
        stripe = self._memory.recall("stripe", view, self._stripe).copy()
        add_speckle(stripe, self._grain, self._config.sensor.speckle, rng)
        self._lens.add_laser(stripe, self._rig.laser.response, gain, image)
        return image

    def _dim_frame(self, view: View) -> Float32Array:
        """Return the short exposure with the laser off."""
        radiance, depth = self._dim_view(view)
        exposure = self._config.sensor.exposure_short_s
        return self._lens.expose(radiance, depth, view.velocity, view.rate, exposure, GREY_OF_WHITE * exposure / NOMINAL_LONG_S)

    def seen(self, view: View) -> SeenPoints:
        """Return what the laser lights and the camera sees bright enough to be noticed; read only."""
        return self._memory.recall("seen", view, self._seen)

    def _seen(self, view: View) -> SeenPoints:
        points, pixels = self._memory.recall("fan", view, self._fan)
        buffer = self._look(view, transform(inverse(view.T_world_cam), points).astype(np.float32))
        albedo, radiance = self._light(view, buffer)
        nearest = np.clip(np.round(pixels).astype(np.int64), 0, [self._lens.width - 1, self._lens.height - 1])
        vignette = self._lens.vignette[nearest[:, 1], nearest[:, 0]][:, None]
        sensor = self._config.sensor
        laser = (albedo @ self._rig.laser.response) * self._sheet(view, buffer) * vignette[:, 0]
        bright = laser * STRIPE_OF_WHITE * sensor.exposure_short_s / NOMINAL_SHORT_S > _VISIBLE_GREY
        light = GREY_OF_WHITE * sensor.exposure_long_s / NOMINAL_LONG_S * vignette * radiance
        return SeenPoints(points[bright], light[bright].astype(np.float64), albedo[bright].astype(np.float64))

    def _full_view(self, view: View) -> tuple[Float32Array, Float32Array]:
        """Return (radiance (H, W, 3), depth (H, W)), several rays a pixel where the surface is not smooth."""
        lens = self._lens
        full, rough = self._interpolated(view)
        radiance = self._light(view, full)[1]
        where = np.flatnonzero(rough)
        if len(where):
            samples = self._look(view, lens.subrays[:, where].reshape(-1, 3))
            radiance[where] = self._light(view, samples)[1].reshape(len(SUBPIXELS), len(where), 3).mean(axis=0)
            full.depth[where] = samples.depth.reshape(len(SUBPIXELS), len(where)).max(axis=0)
        return radiance.reshape(lens.height, lens.width, 3), full.depth.reshape(lens.height, lens.width)

    def _interpolated(self, view: View) -> tuple[GBuffer, BoolArray]:
        """Return all pixels from rays through every second one, and (H·W,) where that is not enough."""
        lens = self._lens
        coarse = self._look(view, lens.coarse_rays)
        full = GBuffer.empty(lens.height * lens.width)
        rough = np.empty(len(full.depth), np.bool_)
        fine, wide = self._turn(view, lens.rays), self._turn(view, lens.coarse_rays)
        gbuffer.enlarge(view.eye, wide, coarse, fine, lens.height, lens.width, full, rough)
        return full, rough

    def _dim_view(self, view: View) -> tuple[Float32Array, Float32Array]:
        """Return the view at a third of the resolution, enlarged: a short exposure hardly shows it above the noise."""
        lens = self._lens
        buffer = self._look(view, lens.dim_rays)
        radiance = lens.enlarge(self._light(view, buffer)[1].reshape(*lens.dim_shape, 3))
        return radiance, lens.enlarge(buffer.depth.reshape(lens.dim_shape))

    def _stripe(self, view: View) -> Float32Array:
        """Return the light of the laser on the surface (H, W), 1 on white at the nominal distance."""
        stripe = np.zeros(self._lens.height * self._lens.width, np.float32)
        where = self._band(view)
        if len(where):
            buffer = self._look(view, self._lens.subrays[:, where].reshape(-1, 3), with_light=False)
            light = self._sheet(view, buffer)
            cut = np.flatnonzero(light > 0)
            response = self._rig.laser.response / self._rig.laser.response.sum()
            light[cut] *= self._albedo(buffer.at(cut)) @ response
            stripe[where] = light.reshape(len(SUBPIXELS), -1).mean(axis=0)
        return stripe.reshape(self._lens.height, self._lens.width)

    def _fan(self, view: View) -> tuple[FloatArray, FloatArray]:
        """Return where the sheet meets the surface in view of the camera: points (N, 3) in the world and pixels (N, 2)."""
        origin = transform(view.T_world_cam, self._rig.laser.origin[None])[0]
        directions = (self._rig.laser.fan(_FAN_RAYS) @ view.T_world_cam[:3, :3].T).astype(np.float32)
        hits = self.caster.cast(origin, directions)
        points = (origin + hits.distance[:, None] * directions.astype(np.float64))[hits.triangle >= 0]
        pixels = self._rig.camera.project(transform(inverse(view.T_world_cam), points))
        with np.errstate(invalid="ignore"):
            inside = np.all((pixels > -0.5) & (pixels < [self._lens.width - 0.5, self._lens.height - 0.5]), axis=1)
        points, pixels = points[inside], pixels[inside]
        visible = self.caster.visible(view.eye, points.astype(np.float32))
        return points[visible], pixels[visible]

    def _band(self, view: View) -> IntArray:
        """Return the pixels (flat index) that the sheet may reach, around where its middle is seen."""
        points, pixels = self._memory.recall("fan", view, self._fan)
        mask = np.zeros((self._lens.height, self._lens.width), np.uint8)
        if len(points):
            centre = np.clip(np.round(pixels).astype(np.int64), 0, [self._lens.width - 1, self._lens.height - 1])
            mask[centre[:, 1], centre[:, 0]] = 1
            nearest = float(transform(inverse(view.T_world_cam), points)[:, 2].min())
            radius = int(np.ceil(4.5 * (WAIST + DIVERGENCE * nearest) * self._rig.camera.focal_px / nearest)) + 2
            mask = cv2.dilate(mask, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)).astype(np.uint8)
        return np.flatnonzero(mask)

    def _sheet(self, view: View, buffer: GBuffer) -> Float32Array:
        """Return the laser's irradiance (N,) on what the camera sees, zero where something hides the laser."""
        laser = self._rig.laser
        origin = transform(view.T_world_cam, laser.origin[None])[0]
        normal = view.T_world_cam[:3, :3] @ laser.normal
        plane = np.array([*normal, -float(normal @ origin)])
        out = np.empty(len(buffer.depth), np.float32)
        shading.sheet_irradiance(buffer, origin, plane, WAIST, DIVERGENCE, self._nominal, out)
        cut = np.flatnonzero(out > 0)
        out[cut] *= self.caster.visible(origin, buffer.points[cut])
        return out

    def _look(self, view: View, rays: Float32Array, with_light: bool = True) -> GBuffer:
        """Return what lies along rays (N, 3) of the camera frame."""
        directions = self._turn(view, rays)
        hits = self.caster.cast(view.eye, directions)
        out = GBuffer.empty(len(rays))
        gbuffer.resolve(view.eye, directions, hits, self._surface, out)
        # Where rays are not of unit depth, their length counts.
        out.depth[:] *= rays[:, 2]
        if with_light:
            out.lit[:] = self.caster.visible(transform(view.T_world_cam, self._rig.light[None])[0], out.points)
        return out

    @staticmethod
    def _turn(view: View, rays: Float32Array) -> Float32Array:
        out = np.empty_like(rays)
        gbuffer.turn(np.ascontiguousarray(view.T_world_cam[:3, :3]), rays, out)
        return out

    def _albedo(self, buffer: GBuffer) -> Float32Array:
        albedo = np.empty((len(buffer.depth), 3), np.float32)
        shading.surface_albedo(buffer, self._rig.camera.focal_px, self._materials, self._tiles, self._table, albedo)
        return albedo

    def _light(self, view: View, buffer: GBuffer) -> tuple[Float32Array, Float32Array]:
        """Return albedo and radiance (N, 3)."""
        albedo = self._albedo(buffer)
        radiance = np.empty_like(albedo)
        light = transform(view.T_world_cam, self._rig.light[None])[0]
        axis = np.ascontiguousarray(view.T_world_cam[:3, 2])
        shading.illuminate(buffer, albedo, self._materials, np.ascontiguousarray(view.eye), light, axis, self._nominal, radiance)
        return albedo, radiance


def add_speckle(stripe: Float32Array, grain: Float32Array, contrast: float, rng: np.random.Generator) -> None:
    """Multiply a stripe (H, W), in place, by a log-normal field of mean 1 whose grains are those of :func:`grain_kernel`."""
    rows, columns = np.flatnonzero(stripe.any(axis=1)), np.flatnonzero(stripe.any(axis=0))
    if len(rows):
        box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        sigma = np.float32(np.sqrt(np.log1p(contrast**2)))
        field = rng.standard_normal(stripe[box].shape, dtype=np.float32)
        stripe[box] *= np.exp(sigma * cv2.filter2D(field, -1, grain) - np.float32(0.5) * sigma**2)


def grain_kernel(angle: float) -> Float32Array:
    """Return a 9×9 kernel of unit energy, sigma 1.6 px along the stripe, which runs at ``angle`` (rad), and 0.6 px across."""
    y, x = np.mgrid[-4:5, -4:5].astype(np.float64)
    along, across = x * np.cos(angle) + y * np.sin(angle), -x * np.sin(angle) + y * np.cos(angle)
    kernel = np.exp(-0.5 * ((along / 1.6) ** 2 + (across / 0.6) ** 2))
    result: Float32Array = (kernel / np.sqrt((kernel**2).sum())).astype(np.float32)
    return result
