"""Images that the map remembers, each with features whose place on the surface is known: by them a scanner finds its way back.

One is kept where none is near that looks the same way, so that what stays in one place, or goes over the same place again, adds
nothing. The points of its features are where their viewing rays meet the map, once the stripes around have entered.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numba import njit

from vli_common.arrays import ByteArray, FloatArray
from vli_common.camera import CameraModel
from vli_common.types import NANOSECONDS, Image
from vli_mapping.features import describe_image
from vli_mapping.keyframe import MapKeyframe
from vli_mapping.normals import fit_plane
from vli_mapping.point_map import PointMap
from vli_mapping.spatial_hash import neighbours

_SPACING = 0.3
"""Of the distance to the surface: nearer views share most of what they see."""
_MIN_ANGLE_COSINE = float(np.cos(np.radians(25.0)))
_MATURE_NS = 2 * NANOSECONDS
"""By then the stripes that follow a keyframe have swept what it sees, as far as they will."""
_DEPTH_SHARE = 0.35
"""Of the median depth, before and behind it, in which features are looked for."""
_STEP_M, _NEAR_M, _PLANE_M = 4e-4, 3e-4, 6e-4
_MIN_POINTS, _MIN_FEATURES = 5, 25
_MAX_ROUGH_M = 1.5e-4
_MAX_NEIGHBOURS = 64


@dataclass(frozen=True, slots=True)
class _Candidate:
    stamp_ns: int
    pixels: ByteArray
    T_map_camera: FloatArray
    depth: float


class KeyframeIntake:
    """Keyframes on their way into the map: they wait for the stripes around them.

    Args:
        camera: of the images.
    """

    def __init__(self, camera: CameraModel) -> None:
        self._camera = camera
        self._waiting: deque[_Candidate] = deque()

    def offer(self, image: Image, T_map_camera: FloatArray, depth: float, point_map: PointMap) -> None:
        """Take the image of a keyframe that has its last pose, where the map remembers nothing near.

        Args:
            image: long.
            T_map_camera: (4, 4).
            depth: metres, of what it sees.
            point_map: that it is for.
        """
        others = [(item.T_map_camera, item.depth) for item in point_map.keyframes]
        others += [(item.T_map_camera, item.depth) for item in self._waiting]
        if not _is_known(T_map_camera, depth, others):
            self._waiting.append(_Candidate(image.stamp_ns, image.pixels, T_map_camera, depth))

    def learn(self, point_map: PointMap, newest_ns: int | None) -> None:
        """Let the map remember the oldest that waits, if the map around it is there; all of them where ``newest_ns`` is None.

        Args:
            point_map: gives the features their places, and gets the keyframes.
            newest_ns: stamp of the newest scan that has entered.
        """
        while self._waiting and (newest_ns is None or self._waiting[0].stamp_ns + _MATURE_NS <= newest_ns):
            keyframe = self._describe(self._waiting.popleft(), point_map)
            if len(keyframe) >= _MIN_FEATURES:
                point_map.keyframes.append(keyframe)
            if newest_ns is not None:
                return

    def clear(self) -> None:
        """Forget what waits."""
        self._waiting.clear()

    def _describe(self, item: _Candidate, point_map: PointMap) -> MapKeyframe:
        features, rays = describe_image(item.pixels).with_rays(self._camera)
        points = meet(point_map, item.T_map_camera, rays, item.depth)
        there = np.isfinite(points).all(axis=1)
        return MapKeyframe(item.T_map_camera, item.depth, points[there], features.descriptors[there], features.thumbnail)


def meet(point_map: PointMap, T_map_camera: FloatArray, rays: FloatArray, depth: float) -> FloatArray:
    """Return where viewing rays (N, 2) meet the map first, (N, 3); NaN where they do not, or the surface is rough there.

    Args:
        point_map: of the surface.
        T_map_camera: (4, 4).
        rays: undistorted, normalised.
        depth: metres, about which the surface is looked for.
    """
    points = np.full((len(rays), 3), np.nan)
    c, grid = point_map.columns, point_map.grid
    directions = np.column_stack([rays, np.ones(len(rays))]) @ T_map_camera[:3, :3].T
    reach = ((1 - _DEPTH_SHARE) * depth, (1 + _DEPTH_SHARE) * depth)
    _meet((grid.heads, grid.next, grid.cell_m), c.position, c.solid, T_map_camera[:3, 3].copy(), directions, reach, points)
    return points


@njit(cache=True, nogil=True)
def _meet(grid, position, solid, eye, directions, reach, points):  # type: ignore[no-untyped-def]
    """Step along each ray until there are solid points about it; write where it cuts their plane."""
    heads, following, cell_m = grid
    found = np.empty(_MAX_NEIGHBOURS, np.int64)
    at, plane = np.empty(3), np.empty(8)
    for index in range(len(directions)):
        ray = directions[index]
        step = _STEP_M / np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
        depth = reach[0]
        while depth < reach[1]:
            at[:] = eye + depth * ray
            if _solid_near(heads, following, position, solid, at, _NEAR_M, cell_m, found) > 0:
                at[:] = eye + (depth + 0.5 * step) * ray
                count = _solid_near(heads, following, position, solid, at, _PLANE_M, cell_m, found)
                fit_plane(position, found[:count], at, plane)
                facing = plane[3] * ray[0] + plane[4] * ray[1] + plane[5] * ray[2]
                if count >= _MIN_POINTS and plane[7] < _MAX_ROUGH_M and abs(facing) > 0.3:
                    offset = plane[3] * (plane[0] - eye[0]) + plane[4] * (plane[1] - eye[1]) + plane[5] * (plane[2] - eye[2])
                    cut = offset / facing
                    if abs(cut - depth) < 3 * step:
                        points[index] = eye + cut * ray
                break
            depth += step


@njit(cache=True, nogil=True)
def _solid_near(heads, following, position, solid, at, radius, cell_m, found):  # type: ignore[no-untyped-def]
    """Write the solid points within ``radius`` of ``at`` into ``found``; return how many."""
    kept = 0
    for row in found[: neighbours(heads, following, position, at, radius, cell_m, found)]:
        if solid[row]:
            found[kept] = row
            kept += 1
    return kept


def _is_known(T_map_camera: FloatArray, depth: float, others: list[tuple[FloatArray, float]]) -> bool:
    """Return True where a pose among ``others`` sees from about the same place in about the same direction."""
    if not others:
        return False
    T = np.stack([pose for pose, _ in others])
    reach = _SPACING * np.minimum(np.array([far for _, far in others]), depth)
    near = np.linalg.norm(T[:, :3, 3] - T_map_camera[:3, 3], axis=1) < reach
    alike = T[:, :3, 2] @ T_map_camera[:3, 2] > _MIN_ANGLE_COSINE
    return bool((near & alike).any())
