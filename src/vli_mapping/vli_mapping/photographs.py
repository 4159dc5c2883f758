"""Long images that are kept to the end of a scan, and what they say together of the colours of the map.

A stripe gets its colours while it is scanned, from the two long images around it, whatever light falls on it just then. On the
way past, other images see the same spot from other places: of its albedo ρ each shows c = ρ · E, E as in ``light``. Their noise
is much the same in c, so the best that all of them say is ρ = Σ c E / Σ E², where an image that looks along the light onto the
spot counts most, and one that meets it at a grazing angle, where the smallest error of the normal is a large one of E, next to
nothing. How badly ρ · E fits what they show, 1 − (Σ c E)² / (Σ E² · Σ c²) of the grey levels, tells where light or normal are
wrong. All this needs the light and the normals as they are known in the end: hence the images are kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from vli_common.arrays import BoolArray, ByteArray, FloatArray, IntArray
from vli_common.camera import CameraModel
from vli_common.geometry import inverse, transform
from vli_common.types import Image
from vli_mapping.albedo import mean_normals
from vli_mapping.colour import sample_colours
from vli_mapping.entry import facing
from vli_mapping.light import Light
from vli_mapping.point_map import PointMap

_MOST = 512
"""Photographs: some 50 MB at VGA."""
_QUALITY = 95
"""Of the JPEG: it changes a grey level by one or two."""
_SPACING, _MIN_ANGLE_COSINE = 0.1, float(np.cos(np.radians(6.0)))
"""Of the distance to the surface, and of the optical axis: nearer views say the same."""
_REACH = 1.6
"""Times the median depth of a photograph, as far as it is asked about."""
_MOST_INCIDENCE_DEG = 70.0
"""Of a line of sight: beyond, a pixel shows too much of the surface."""
_BLOCK_M = 8e-3
"""Edge of the blocks that a map is cut into, to find what a photograph may show."""


@dataclass(frozen=True, slots=True)
class Photograph:
    """A long image with its last pose.

    Args:
        encoded: (B,) uint8, JPEG.
        T_map_camera: (4, 4).
        depth: metres, median distance of the surface along the optical axis.
    """

    encoded: ByteArray
    T_map_camera: FloatArray
    depth: float

    @staticmethod
    def of(pixels: ByteArray, T_map_camera: FloatArray, depth: float) -> Photograph:
        """Encode an image (H, W, 3) BGR or (H, W) grey."""
        _, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        return Photograph(encoded.ravel(), T_map_camera.copy(), depth)

    def pixels(self) -> ByteArray:
        """Return the image (H, W, 3) BGR or (H, W) grey."""
        return np.asarray(cv2.imdecode(self.encoded, cv2.IMREAD_UNCHANGED), np.uint8)


class Album:
    """The photographs of a scan; where there are too many, every second one goes, so that they are spread over all of it."""

    def __init__(self) -> None:
        self.photographs: list[Photograph] = []
        self._spacing = _SPACING
        self._latest: FloatArray | None = None

    def offer(self, image: Image, T_map_camera: FloatArray, depth: float) -> None:
        """Take a long image that has its last pose, if it does not look from where the one before it did.

        Args:
            image: long.
            T_map_camera: (4, 4).
            depth: metres, of what it sees.
        """
        if self._latest is not None and _is_alike(self._latest, T_map_camera, self._spacing * depth):
            return
        photograph = Photograph.of(image.pixels, T_map_camera, depth)
        self._latest = photograph.T_map_camera
        self.photographs.append(photograph)
        if len(self.photographs) > _MOST:
            self.photographs = self.photographs[::2]
            self._spacing *= 2.0

    def clear(self) -> None:
        """Forget all photographs."""
        self.photographs.clear()
        self._spacing, self._latest = _SPACING, None


def develop(point_map: PointMap, light: Light | None, camera: CameraModel, photographs: Sequence[Photograph]) -> None:
    """Let a map know what photographs of it say of the albedo of its points, beside what others have said before.

    Args:
        point_map: its columns ``albedo`` and ``albedo_weight`` change.
        light: on board; without one there is nothing to say.
        camera: that took the photographs.
        photographs: each is to be developed once.
    """
    which = point_map.alive()
    if light is None or not photographs or not len(which):
        return
    c = point_map.columns
    position, normals = c.position[which], mean_normals(point_map, which)
    weight, power = c.albedo_weight[which].astype(np.float64), c.albedo_power[which].astype(np.float64)
    total = c.albedo[which] * weight[:, None]
    blocks = _Blocks(position, camera)
    for photograph in photographs:
        rows, local = blocks.before(photograph)
        colours, seen = sample_colours(camera, local, photograph.pixels())
        turned = normals[rows] @ photograph.T_map_camera[:3, :3]
        seen &= facing(local, turned.astype(np.float32), _MOST_INCIDENCE_DEG)
        rows, colours = rows[seen], colours[seen]
        shading = light.shading(local[seen], turned[seen])
        total[rows] += shading[:, None] * colours
        weight[rows] += shading**2
        power[rows] += colours.mean(axis=1) ** 2
    c.albedo[which] = total / np.where(weight > 0, weight, 1.0)[:, None]
    c.albedo_weight[which], c.albedo_power[which] = weight, power


class _Blocks:
    """Points (N, 3) before a camera, in blocks of which a photograph leaves most out without a look at each point."""

    def __init__(self, points: FloatArray, camera: CameraModel) -> None:
        self._points = points
        self._corner = float(np.hypot(*np.nanmax(np.abs(camera.unproject(camera.pixel_grid(2))), axis=0)))
        cells = np.floor(points / _BLOCK_M).astype(np.int64)
        self._order = np.lexsort(cells.T)
        change = np.diff(cells[self._order], axis=0, prepend=cells[self._order[:1]] - 1).any(axis=1)
        self._starts = np.flatnonzero(change)
        self._centres = _BLOCK_M * (cells[self._order[self._starts]] + 0.5).astype(np.float64)

    def before(self, photograph: Photograph) -> tuple[IntArray, FloatArray]:
        """Return which points (K,) may be in a photograph, and these points (K, 3) in its camera frame."""
        T_camera_map = inverse(photograph.T_map_camera)
        radius = np.sqrt(0.75) * _BLOCK_M
        near = _in_field(self._corner, transform(T_camera_map, self._centres), radius, _REACH * photograph.depth)
        rows = np.concatenate([np.empty(0, np.int64), *self._members(near)])
        local = transform(T_camera_map, self._points[rows])
        inside = _in_field(self._corner, local, 0.0, _REACH * photograph.depth)
        return rows[inside], local[inside]

    def _members(self, near: BoolArray) -> Iterator[IntArray]:
        ends = np.append(self._starts[1:], len(self._order))
        return (self._order[self._starts[block] : ends[block]] for block in np.flatnonzero(near))


def _in_field(corner: float, points: FloatArray, radius: float, reach: float) -> BoolArray:
    """Return which balls of ``radius`` about points (N, 3), camera frame, touch the cone around the field of view.

    Args:
        corner: tangent of its half angle.
        points, radius: metres.
        reach: along the axis, metres.
    """
    across, z = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
    result: BoolArray = (across - corner * z < radius * np.hypot(1.0, corner)) & (z > -radius) & (z < reach + radius)
    return result


def _is_alike(first: FloatArray, second: FloatArray, distance: float) -> bool:
    """Return True where two poses (4, 4) are within a distance, metres, of each other and look much the same way."""
    apart = np.linalg.norm(first[:3, 3] - second[:3, 3])
    return bool(apart < distance and first[:3, 2] @ second[:3, 2] > _MIN_ANGLE_COSINE)
