"""Scans between their first pose and their last: joined with pose and long images by stamp, coloured, described."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from vli_common.arrays import BoolArray, Float32Array, FloatArray, IntArray
from vli_common.camera import CameraModel
from vli_common.geometry import inverse, transform
from vli_common.types import NANOSECONDS, Counters, FrameKind, Image, LaserScan, WindowPoses
from vli_mapping.colour import colour_points, sight
from vli_mapping.config import MappingConfig
from vli_mapping.entry import away_from_edges, facing, noisy, supported
from vli_mapping.light import Sightings
from vli_mapping.normals import stripe_normals

Stamped = TypeVar("Stamped", Image, LaserScan)
_SPOTS_PER_SCAN = 6
"""Of the light: neighbours along a stripe say the same."""
_MOST_WAITING = 1000
"""Images, or scans, of whatever stamps: a sender that counts nanoseconds must not fill the memory."""


@dataclass(frozen=True, slots=True)
class Probe:
    """Some points (K, 3) of a scan in its camera frame, with normals (K, 3), colours (K, 3) and sigma (K,)."""

    points: FloatArray
    normals: Float32Array
    colours: Float32Array
    sigma: FloatArray


@dataclass
class PosedScan:
    """A scan with its pose of now.

    Args:
        scan: as triangulated.
        number: counts the scans of the session, ascending.
        T_map_camera: (4, 4).
        colours: (N, 3) float32 RGB, NaN where no long image shows the point.
        solid: (N,), False for points that may fly: at edges, grazing, or backed by no scan beside this one.
        usable: (N,), False for points that almost surely do: not solid, and the stripe is blurred there.
        normals: (N, 3) float32 in the camera frame, 0 = none.
        planarity: (N,) float32.
        described: whether normals and ``solid`` are from both scans beside this one.
    """

    scan: LaserScan
    number: int
    T_map_camera: FloatArray
    colours: Float32Array
    solid: BoolArray
    usable: BoolArray
    normals: Float32Array
    planarity: Float32Array
    described: bool = False
    final: bool = False
    redundant: bool = False
    published: bool = False
    _probe: Probe | None = None

    def probe(self, count: int) -> Probe:
        """Return at least ``count`` solid points, spread evenly along the stripe (or all, where there are fewer)."""
        if self._probe is not None:
            return self._probe
        solid = np.flatnonzero(self.solid)
        which = solid[:: max(len(solid) // count, 1)]
        probe = Probe(self.scan.points[which], self.normals[which], self.colours[which], self.scan.sigma[which])
        if self.described:
            self._probe = probe
        return probe

    @property
    def points(self) -> FloatArray:
        """Points (N, 3) in map."""
        return transform(self.T_map_camera, self.scan.points)

    @property
    def map_normals(self) -> Float32Array:
        """Normals (N, 3) float32 in map."""
        return (self.normals @ self.T_map_camera[:3, :3].T).astype(np.float32)

    @property
    def viewpoint(self) -> FloatArray:
        """Camera centre (3,) in map."""
        viewpoint: FloatArray = self.T_map_camera[:3, 3].copy()
        return viewpoint


class ScanWindow:
    """The scans of one session that the back end's window holds, or has just let go.

    Args:
        camera: of the long images.
        config: see :class:`MappingConfig`.
        counters: of the stage; every drop is counted there.
        session: that all items belong to.
    """

    def __init__(self, camera: CameraModel, config: MappingConfig, counters: Counters, session: int = 0) -> None:
        self.session = session
        self._camera, self._config, self._counters = camera, config, counters
        self._images: dict[int, Image] = {}
        self._waiting: dict[int, LaserScan] = {}
        self._long_poses: dict[int, FloatArray] = {}
        self._scans: dict[int, PosedScan] = {}
        self._keyframes: set[int] = set()
        self._last_final: PosedScan | None = None
        self._next_number = 0

    def successor(self, session: int) -> ScanWindow:
        """Return an empty window for another session, with what has come of that session already."""
        result = ScanWindow(self._camera, self._config, self._counters, session)
        result._images.update((stamp, item) for stamp, item in self._images.items() if item.session == session)
        result._waiting.update((stamp, item) for stamp, item in self._waiting.items() if item.session == session)
        return result

    def count_from(self, number: int) -> None:
        """Let the scans be numbered from here on, those that are in the window too."""
        for item in self._scans.values():
            item.number += number
        self._next_number += number

    def add_image(self, image: Image) -> None:
        """Take a long image; it is forgotten when it has coloured its scans, or waited too long."""
        self._images[image.stamp_ns] = image
        self._forget(self._images, image.stamp_ns, "images_expired")

    def add_scan(self, scan: LaserScan) -> None:
        """Take a scan; it waits for its pose."""
        self._waiting[scan.stamp_ns] = scan
        self._forget(self._waiting, scan.stamp_ns, "scans_without_pose")

    def update(self, window: WindowPoses) -> None:
        """Give every frame of the window its pose; colour and describe the scans that are new."""
        short = window.kinds == FrameKind.SHORT.value
        for index in np.flatnonzero(~short):
            self._long_poses[int(window.stamps[index])] = window.T_map_camera[index]
        views = self._views()
        for index in np.flatnonzero(short):
            stamp, T_map_camera = int(window.stamps[index]), window.T_map_camera[index]
            item = self._scans.get(stamp) or self._begin(stamp, T_map_camera, bool(window.redundant[index]), views)
            if item is not None:
                item.T_map_camera = T_map_camera
                item.final, item.redundant = bool(window.final[index]), bool(window.redundant[index])
        self._describe()

    def leaving(self) -> Iterator[PosedScan]:
        """Yield the scans that are final and add something, in order of time."""
        return (item for item in self._useful() if item.final)

    def staying(self) -> list[PosedScan]:
        """Return the scans whose poses may still change, in order of time."""
        return [item for item in self._useful() if not item.final]

    def unpublished(self) -> list[PosedScan]:
        """Return the scans that this has not returned before, in order of time."""
        fresh = [item for item in self._useful() if not item.published]
        for item in fresh:
            item.published = True
        return fresh

    def keyframe_images(self, window: WindowPoses) -> list[tuple[Image, int]]:
        """Return the images of the window's keyframes, as far as they are there, and their rows in it, in order of time."""
        rows = np.flatnonzero(window.kinds == FrameKind.KEYFRAME.value)
        found = [(self._images.get(int(window.stamps[row])), int(row)) for row in rows]
        return [(image, row) for image, row in found if image is not None and image.session == self.session]

    def sightings(self) -> Sightings:
        """Return how the keyframes' images show some spots of the scans that leave, from all over the field of view."""
        points, normals = [np.empty((0, 3))], [np.empty((0, 3), np.float32)]
        for item in self.leaving():
            flat = np.flatnonzero(item.solid & item.normals.any(axis=1))
            which = flat[:: max(len(flat) // _SPOTS_PER_SCAN, 1)]
            points.append(item.points[which])
            normals.append(item.map_normals[which])
        stamps = sorted(stamp for stamp in self._keyframes if stamp in self._images and stamp in self._long_poses)
        views = [(self._images[stamp].pixels, self._long_poses[stamp]) for stamp in stamps]
        return sight(self._camera, np.concatenate(points), np.concatenate(normals), views)

    def release(self, window: WindowPoses) -> None:
        """Forget what no later window can ask for."""
        final = [item for item in self._scans.values() if item.final]
        self._counters.add("scans_redundant", sum(item.redundant for item in final))
        self._last_final = next((item for item in reversed(list(self.leaving()))), self._last_final)
        for item in final:
            del self._scans[item.scan.stamp_ns]
        newest = int(window.stamps[-1]) if len(window) else window.stamp_ns
        oldest = newest - int(self._config.colour_gap_s * NANOSECONDS)
        keyframes = (window.kinds == FrameKind.KEYFRAME.value) & ~window.final
        self._keyframes = set(window.stamps[keyframes].tolist())
        self._images = {stamp: item for stamp, item in self._images.items() if stamp >= oldest or stamp in self._keyframes}
        self._long_poses = {stamp: T for stamp, T in self._long_poses.items() if stamp >= oldest or stamp in self._keyframes}

    def _useful(self) -> list[PosedScan]:
        return [self._scans[stamp] for stamp in sorted(self._scans) if not self._scans[stamp].redundant]

    def _begin(self, stamp: int, T_map_camera: FloatArray, redundant: bool, views: IntArray) -> PosedScan | None:
        """Return the scan of a stamp that has its first pose; None where there is none, or nothing in it."""
        scan = self._waiting.pop(stamp, None)
        if scan is None or scan.session != self.session:
            self._counters.add("poses_without_scan")
            return None
        if len(scan) == 0:
            self._counters.add("scans_empty")
            return None
        count = len(scan)
        colours = np.full((count, 3), np.nan, np.float32) if redundant else self._colour(scan, T_map_camera, views)
        every, normals, planarity = np.ones(count, np.bool_), np.zeros((count, 3), np.float32), np.zeros(count, np.float32)
        item = self._scans[stamp] = PosedScan(scan, self._next_number, T_map_camera, colours, every, every, normals, planarity)
        self._next_number += 1
        return item

    def _views(self) -> IntArray:
        """Return the stamps of the long images that have a pose, ascending."""
        known = [stamp for stamp in self._long_poses if stamp in self._images and self._images[stamp].session == self.session]
        return np.array(sorted(known), np.int64)

    def _colour(self, scan: LaserScan, T_map_camera: FloatArray, views: IntArray) -> Float32Array:
        """Return the colours (N, 3) of a scan from the long images before and after it."""
        at = int(np.searchsorted(views, scan.stamp_ns))
        gap = int(self._config.colour_gap_s * NANOSECONDS)
        near = [int(stamp) for stamp in views[max(at - 1, 0) : at + 1] if abs(int(stamp) - scan.stamp_ns) <= gap]
        if not near:
            self._counters.add("scans_without_image")
        points = transform(T_map_camera, scan.points)
        before = next(reversed(self._scans.values()), self._last_final)
        return colour_points(
            self._camera,
            points,
            [(self._images[stamp].pixels, self._long_poses[stamp]) for stamp in near],
            None if before is None else before.points,
        )

    def _describe(self) -> None:
        """Describe the scans that have just got a successor, and those that leave without one."""
        useful = self._useful()
        before = self._last_final
        for index, item in enumerate(useful):
            after = useful[index + 1] if index + 1 < len(useful) else None
            if not item.described and (after is not None or item.final):
                self._describe_one(item, [other for other in (before, after) if other is not None])
            before = item

    def _describe_one(self, item: PosedScan, beside: list[PosedScan]) -> None:
        """Find normals, and which points are solid. Poses of scans beside each other hardly move against each other any more."""
        config = self._config
        T_camera_map = inverse(item.T_map_camera)
        others = np.concatenate([np.empty((0, 3)), *(transform(T_camera_map, other.points) for other in beside)])
        points = item.scan.points
        item.normals, item.planarity = stripe_normals(points, others, config.map.normal_radius, config.map.min_planarity)
        item.solid = (
            away_from_edges(points, item.scan.sigma, config.entry)
            & supported(points, others, config.entry.support_radius)
            & facing(points, item.normals, config.entry.max_incidence_deg)
        )
        item.usable = item.solid | ~noisy(points, item.scan.sigma, config.entry.max_blur)
        item.described = True

    def _forget(self, items: dict[int, Stamped], now_ns: int, counter: str) -> None:
        oldest = now_ns - int(self._config.image_buffer_s * NANOSECONDS)
        old = [stamp for stamp in items if stamp < oldest] or sorted(items)[: max(0, len(items) - _MOST_WAITING)]
        for stamp in old:
            del items[stamp]
        self._counters.add(counter, len(old))
