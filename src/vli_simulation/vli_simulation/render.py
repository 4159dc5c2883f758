"""One frame: what the camera sees at the middle of an exposure, lit by its own LED or cut by the laser."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vli_common.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from vli_common.camera import CameraModel
from vli_common.geometry import inverse, transform
from vli_simulation import shading
from vli_simulation.caster import RayCaster
from vli_simulation.config import SimulationConfig
from vli_simulation.rig import Rig
from vli_simulation.scenes.scene import Scene
from vli_simulation.texture import noise_table

_GREY_OF_WHITE = 235.0
"""Grey level of a white surface that faces the light at the nominal distance, in the nominal long exposure."""
_NOMINAL_LONG_S, _NOMINAL_SHORT_S = 0.005, 0.0004
_STRIPE_OF_WHITE = 620.0
"""Grey level in the middle of the stripe on white, nominal short exposure: two and a half times saturation."""
_WAIST, _DIVERGENCE = 0.8e-4, 1.4e-3
_WAVEFRONT_PSF_PX = 0.5
_FAN_RAYS = 1600
_VISIBLE_GREY = 12.0
_SUBPIXELS = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))
_MIN_SMEAR_PX = 0.08


@dataclass(frozen=True)
class _Shaded:
    """Radiance and geometry along N rays of the camera."""

    radiance: Float32Array
    albedo: Float32Array
    points: Float32Array
    normals: Float32Array
    triangle: np.ndarray[tuple[int, ...], np.dtype[np.int32]]
    lit: BoolArray


@dataclass(frozen=True)
class SeenPoints:
    """What the laser lit and the camera saw: points (N, 3) in the world, colour as lit and albedo (N, 3) uint8, red green blue."""

    points: FloatArray
    colour: ByteArray
    albedo: ByteArray


class Renderer:
    """Renders a scene as a rig sees it; has no state that frames share, so threads may use one together."""

    def __init__(self, scene: Scene, rig: Rig, config: SimulationConfig, seed: int) -> None:
        self.caster = RayCaster(scene.mesh)
        self._rig, self._config = rig, config
        self._nominal = config.motion.distance
        self._materials = np.array([material.row() for material in scene.materials])
        self._material_of = scene.mesh.material.astype(np.uint8)
        self._tile_of = scene.mesh.tile.astype(np.int32)
        self._uv = np.ascontiguousarray(scene.mesh.uv, dtype=np.float32)
        self._tiles = scene.tiles
        self._table = noise_table(seed)
        self._lens = _LensTables(rig.camera, config.sensor.vignetting)

    def long_frame(self, T_world_cam: FloatArray, twist: tuple[FloatArray, FloatArray]) -> Float32Array:
        """Return the long exposure (H, W, 3), blue green red, in grey levels before sensor noise.

        Args:
            T_world_cam: (4, 4) at mid-exposure.
            twist: velocity and angular velocity (3,) of the camera, in the camera frame.
        """
        sharp, depth = self._view(T_world_cam)
        exposure = self._config.sensor.exposure_long_s
        image = self._blur(sharp, depth, twist, exposure)
        return self._develop(image, _GREY_OF_WHITE * exposure / _NOMINAL_LONG_S)

    def short_frame(self, T_world_cam: FloatArray, twist: tuple[FloatArray, FloatArray], rng: np.random.Generator) -> Float32Array:
        """Return the short exposure with the laser on, as :meth:`long_frame`; ``rng`` draws the speckle."""
        exposure = self._config.sensor.exposure_short_s
        scale = _STRIPE_OF_WHITE / _GREY_OF_WHITE * (_NOMINAL_LONG_S / _NOMINAL_SHORT_S)
        dim, depth = self._dim_view(T_world_cam)
        image = self._blur(dim, depth, twist, exposure)
        stripe = self._stripe(T_world_cam)
        if self._config.sensor.speckle > 0:
            stripe *= self._speckle(rng)
        image += scale * stripe[..., None] * self._rig.laser.response.astype(np.float32)
        return self._develop(image, _GREY_OF_WHITE * exposure / _NOMINAL_LONG_S)

    def seen(self, T_world_cam: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return what the laser lights and the camera sees: points (N, 3) in the world, their light (N, 3), albedo (N, 3).

        Exact: rays from the laser within its plane. Light is in grey levels of a long exposure; blue green red.
        """
        points, pixels = self._fan(T_world_cam)
        shaded = self._shade(T_world_cam, transform(inverse(T_world_cam), points))
        column = np.clip(np.round(pixels).astype(np.int64), 0, [self._lens.width - 1, self._lens.height - 1])
        vignette = self._lens.vignette[column[:, 1], column[:, 0]][:, None]
        laser = shaded.albedo @ self._rig.laser.response * self._sheet(T_world_cam, shaded) * vignette[:, 0]
        exposures = self._config.sensor
        bright = laser * _STRIPE_OF_WHITE * exposures.exposure_short_s / _NOMINAL_SHORT_S > _VISIBLE_GREY
        light = _GREY_OF_WHITE * exposures.exposure_long_s / _NOMINAL_LONG_S * vignette * shaded.radiance
        return points[bright], light[bright].astype(np.float64), shaded.albedo[bright].astype(np.float64)

    def _fan(self, T_world_cam: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return where the sheet meets the surface in view of the camera: points (N, 3) in the world and pixels (N, 2)."""
        origin = transform(T_world_cam, self._rig.laser.origin[None])[0]
        directions = self._rig.laser.fan(_FAN_RAYS) @ T_world_cam[:3, :3].T
        hits = self.caster.cast(origin, directions)
        points = (origin + hits.distance[:, None] * directions.astype(np.float32).astype(np.float64))[hits.triangle >= 0]
        pixels = self._rig.camera.project(transform(inverse(T_world_cam), points))
        with np.errstate(invalid="ignore"):
            inside = np.all((pixels > -0.5) & (pixels < [self._lens.width - 0.5, self._lens.height - 0.5]), axis=1)
        points, pixels = points[inside], pixels[inside]
        visible = self.caster.visible(T_world_cam[:3, 3], points.astype(np.float32))
        return points[visible], pixels[visible]

    def _view(self, T_world_cam: FloatArray) -> tuple[Float32Array, Float32Array]:
        """Return (radiance (H, W, 3), depth (H, W)), with four rays a pixel where one is not enough."""
        shape = self._lens.height, self._lens.width
        shaded = self._shade(T_world_cam, self._lens.rays)
        depth = self._depth(T_world_cam, shaded).reshape(shape)
        mask = np.zeros(shape, np.bool_)
        shading.edge_mask(
            depth, shaded.normals.reshape(*shape, 3), shaded.triangle.reshape(shape), self._material_of, shaded.lit.reshape(shape), mask
        )
        where = np.flatnonzero(mask)
        if len(where):
            samples = self._shade(T_world_cam, self._lens.subrays[:, where].reshape(-1, 3)).radiance
            shaded.radiance[where] = samples.reshape(len(_SUBPIXELS), len(where), 3).mean(axis=0)
        return shaded.radiance.reshape(*shape, 3), depth

    def _dim_view(self, T_world_cam: FloatArray) -> tuple[Float32Array, Float32Array]:
        """Return the view at half the resolution, enlarged: a short exposure hardly shows it above the noise."""
        shaded = self._shade(T_world_cam, self._lens.coarse_rays)
        shape, size = self._lens.coarse_shape, (self._lens.width, self._lens.height)
        radiance = self._lens.enlarge(shaded.radiance.reshape(*shape, 3))
        depth = cv2.resize(self._depth(T_world_cam, shaded).reshape(shape), size, interpolation=cv2.INTER_NEAREST)
        return radiance, depth

    def _stripe(self, T_world_cam: FloatArray) -> Float32Array:
        """Return the light of the laser (H, W) by the surface, 1 on white at the nominal distance; four rays a pixel of the band."""
        stripe = np.zeros(self._lens.height * self._lens.width, np.float32)
        where = self._band(T_world_cam)
        if not len(where):
            return stripe.reshape(self._lens.height, self._lens.width)
        shaded = self._shade(T_world_cam, self._lens.subrays[:, where].reshape(-1, 3), with_light=False)
        light = self._sheet(T_world_cam, shaded) * (shaded.albedo @ (self._rig.laser.response / self._rig.laser.response.sum()))
        stripe[where] = light.reshape(len(_SUBPIXELS), -1).mean(axis=0)
        return stripe.reshape(self._lens.height, self._lens.width)

    def _band(self, T_world_cam: FloatArray) -> IntArray:
        """Return the pixels (flat index) that the sheet may reach, around where its middle is seen."""
        points, pixels = self._fan(T_world_cam)
        mask = np.zeros((self._lens.height, self._lens.width), np.uint8)
        if len(points):
            centre = np.clip(np.round(pixels).astype(np.int64), 0, [self._lens.width - 1, self._lens.height - 1])
            mask[centre[:, 1], centre[:, 0]] = 1
            nearest = float(transform(inverse(T_world_cam), points)[:, 2].min())
            radius = int(np.ceil(5.0 * (_WAIST + _DIVERGENCE * nearest) * self._rig.camera.focal_px / nearest)) + 3
            mask = cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))).astype(np.uint8)
        return np.flatnonzero(mask)

    def _sheet(self, T_world_cam: FloatArray, shaded: _Shaded) -> Float32Array:
        laser = self._rig.laser
        origin = transform(T_world_cam, laser.origin[None])[0]
        normal = T_world_cam[:3, :3] @ laser.normal
        plane = np.array([*normal, -float(normal @ origin)])
        lit = self.caster.visible(origin, shaded.points) & (shaded.triangle >= 0)
        out = np.empty(len(lit), np.float32)
        shading.sheet_irradiance(shaded.points, shaded.normals, lit, origin, plane, _WAIST, _DIVERGENCE, self._nominal, out)
        return out

    def _shade(self, T_world_cam: FloatArray, rays: FloatArray | Float32Array, with_light: bool = True) -> _Shaded:
        """Return what the camera sees along rays (N, 3) of its frame; where ``z`` is 1, distances are depths."""
        rotation, eye = T_world_cam[:3, :3], T_world_cam[:3, 3]
        directions = rays.astype(np.float32) @ rotation.T.astype(np.float32)
        hits = self.caster.cast(eye, directions)
        count = len(directions)
        points, normals, albedo, radiance = (np.empty((count, 3), np.float32) for _ in range(4))
        caster = self.caster
        shading.surface_points(
            eye, directions, hits.distance, hits.u, hits.v, hits.triangle, caster.faces, caster.vertices, caster.normals, points, normals
        )
        reach = np.linalg.norm(points - eye.astype(np.float32), axis=1)
        footprint = np.maximum(reach / np.float32(self._rig.camera.focal_px), np.float32(1e-6))
        shading.surface_albedo(
            points, hits.u, hits.v, hits.triangle, footprint, caster.faces, self._material_of, self._tile_of, self._uv, self._materials,
            self._tiles, self._table, albedo,
        )  # fmt: skip
        lit = np.zeros(count, np.bool_)
        if with_light:
            light = transform(T_world_cam, self._rig.light[None])[0]
            lit = caster.visible(light, points)
            shading.illuminate(
                points, normals, hits.triangle, lit, self._material_of, self._materials, eye, light, rotation[:, 2], self._nominal, albedo,
                radiance,
            )  # fmt: skip
        return _Shaded(radiance, albedo, points, normals, hits.triangle, lit)

    @staticmethod
    def _depth(T_world_cam: FloatArray, shaded: _Shaded) -> Float32Array:
        along = (shaded.points - T_world_cam[:3, 3].astype(np.float32)) @ T_world_cam[:3, 2].astype(np.float32)
        result: Float32Array = np.where(shaded.triangle >= 0, along, np.float32(0))
        return result

    def _blur(self, image: Float32Array, depth: Float32Array, twist: tuple[FloatArray, FloatArray], exposure_s: float) -> Float32Array:
        flow = np.empty((*depth.shape, 2), np.float32)
        shading.image_motion(self._lens.flat_rays, depth, self._lens.jacobian, *twist, flow)
        longest = float(np.abs(flow).max()) * exposure_s
        if longest < _MIN_SMEAR_PX:
            return image
        out = np.empty_like(image)
        shading.smear(image, flow, exposure_s, int(np.clip(np.ceil(3 * longest), 3, 24)), out)
        return out

    def _develop(self, image: Float32Array, gain: float) -> Float32Array:
        soft = cv2.GaussianBlur(image, (0, 0), _WAVEFRONT_PSF_PX)
        result: Float32Array = (soft * (np.float32(gain) * self._lens.vignette[..., None])).astype(np.float32)
        return result

    def _speckle(self, rng: np.random.Generator) -> Float32Array:
        """Return a log-normal field (H, W) of mean 1 whose grains are drawn out along the stripe."""
        contrast = self._config.sensor.speckle
        field = rng.standard_normal((self._lens.height, self._lens.width), dtype=np.float32)
        kernel = _grain(np.deg2rad(self._config.rig.stripe_angle_deg))
        sigma = np.float32(np.sqrt(np.log1p(contrast**2)))
        result: Float32Array = np.exp(sigma * cv2.filter2D(field, -1, kernel) - np.float32(0.5) * sigma**2)
        return result


class _LensTables:
    """What follows from the lens alone: rays, their subpixel neighbours, Jacobians, vignetting."""

    def __init__(self, camera: CameraModel, vignetting: float) -> None:
        self.height, self.width = camera.height, camera.width
        u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
        pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
        flat = camera.unproject(pixels)
        self.rays = _with_depth(flat)
        self.flat_rays = flat.reshape(self.height, self.width, 2).astype(np.float32)
        self.subrays = np.stack([_with_depth(camera.unproject(pixels + offset)) for offset in _SUBPIXELS])
        self.jacobian = self._jacobians(camera, flat)
        self.coarse_shape = (self.height + 1) // 2 + 1, (self.width + 1) // 2 + 1
        cu, cv = np.meshgrid(2.0 * np.arange(self.coarse_shape[1]) - 0.5, 2.0 * np.arange(self.coarse_shape[0]) - 0.5)
        self.coarse_rays = _with_depth(camera.unproject(np.stack([cu, cv], axis=-1).reshape(-1, 2)))
        radius2 = ((u - camera.cx) ** 2 + (v - camera.cy) ** 2) / (0.25 * (camera.width**2 + camera.height**2))
        self.vignette = (1 - vignetting * (0.8 * radius2 + 0.2 * radius2**2)).clip(0.02).astype(np.float32)

    def enlarge(self, coarse: Float32Array) -> Float32Array:
        """Return an image on the coarse grid (pixels −0.5, 1.5, 3.5, …) at full resolution, bilinear."""
        matrix = np.array([[0.5, 0, 0.25], [0, 0.5, 0.25]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        result: Float32Array = cv2.warpAffine(coarse, matrix, (self.width, self.height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return result

    def _jacobians(self, camera: CameraModel, rays: FloatArray) -> Float32Array:
        step = 1e-5
        columns = [(camera.to_pixels(rays + offset) - camera.to_pixels(rays - offset)) / (2 * step) for offset in step * np.eye(2)]
        return np.stack(columns, axis=-1).reshape(self.height, self.width, 2, 2).astype(np.float32)


def _with_depth(rays: FloatArray) -> Float32Array:
    return np.column_stack([rays, np.ones(len(rays))]).astype(np.float32)


def _grain(angle: float) -> Float32Array:
    """Return a 9×9 kernel of unit energy, sigma 1.6 px along the stripe and 0.6 px across."""
    y, x = np.mgrid[-4:5, -4:5].astype(np.float64)
    along, across = x * np.cos(angle) + y * np.sin(angle), -x * np.sin(angle) + y * np.cos(angle)
    kernel = np.exp(-0.5 * ((along / 1.6) ** 2 + (across / 0.6) ** 2))
    result: Float32Array = (kernel / np.sqrt((kernel**2).sum())).astype(np.float32)
    return result
