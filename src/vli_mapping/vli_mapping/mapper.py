"""The mapping stage: windows of poses in; map, constraints on the window, and live cloud out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vli_common.arrays import BoolArray, Float32Array, FloatArray, IntArray
from vli_common.calibration import Calibration
from vli_common.geometry import transform
from vli_common.types import (
    NANOSECONDS,
    Counters,
    FrameKind,
    Image,
    LaserScan,
    MapConstraints,
    MappingOutput,
    Mode,
    PointCloud,
    WindowPoses,
)
from vli_mapping.association import WindowScan, associate
from vli_mapping.colour import colour_points
from vli_mapping.config import MappingConfig
from vli_mapping.entry import away_from_edges, not_grazing, supported
from vli_mapping.normals import stripe_normals
from vli_mapping.point_map import PointMap, Stripe, to_bytes

_REFINE_DELAY = 3
"""Scans that enter after one before its normals are fitted again: by then the surface around it is there."""


@dataclass
class _Scan:
    """A scan that has a pose, from its first window until it has entered the map."""

    scan: LaserScan
    number: int
    T_map_camera: FloatArray
    colours: Float32Array
    final: bool = False
    redundant: bool = False
    published: bool = False

    @property
    def points(self) -> FloatArray:
        return transform(self.T_map_camera, self.scan.points)

    @property
    def viewpoint(self) -> FloatArray:
        viewpoint: FloatArray = self.T_map_camera[:3, 3]
        return viewpoint


class Mapper:
    """Joins scans and long images with the poses of the window; scans enter the map with their final poses, after the solve.

    Args:
        calibration: of the camera.
        config: see :class:`MappingConfig`.
        mode: whether the window is aligned to the map.
    """

    def __init__(self, calibration: Calibration, config: MappingConfig | None = None, mode: Mode = Mode.VLI_SLAM) -> None:
        self.config = config or MappingConfig()
        self.counters = Counters()
        self.constrains = mode.uses_map
        """Whether the window is aligned to the map, eq. (4); may be switched at any time."""
        self.map = PointMap(self.config.map)
        self._camera = calibration.camera
        self._uses_laser = mode.uses_laser
        self._session = 0
        self._clear()

    def add_image(self, image: Image) -> None:
        """Take a long image, for colour."""
        if not self._uses_laser:
            return
        self._images[image.stamp_ns] = image
        self._forget(self._images, image.stamp_ns - int(self.config.image_buffer_s * NANOSECONDS), "images_expired")

    def add_scan(self, scan: LaserScan) -> None:
        """Take the stripe of a short frame; it waits for its pose."""
        self._waiting[scan.stamp_ns] = scan
        self._forget(self._waiting, scan.stamp_ns - int(self.config.image_buffer_s * NANOSECONDS), "scans_without_pose")

    def add_window(self, window: WindowPoses) -> MappingOutput:
        """Take the poses after a solve: enter what is final, then relate what is not to the map, eq. (4)."""
        if window.session != self._session:
            self.reset(window.session)
        self._take_poses(window)
        touched = self._enter_final()
        constraints = self._constrain(window) if self.constrains else None
        cloud = self._live_cloud(window.stamp_ns)
        self._release(window)
        update = self.map.cloud(touched, window.stamp_ns, self._session) if len(touched) else None
        return MappingOutput(constraints, cloud, update)

    def reset(self, session: int) -> None:
        """Drop all that belongs to another session, and start a new map: poses of two sessions share no frame.

        The old map stays intact for whoever holds it.
        """
        self.counters.add("sessions")
        if len(self.map):
            self.map = PointMap(self.config.map)
        images, waiting = self._images, self._waiting
        self._session = session
        self._clear()
        self._images.update((stamp, item) for stamp, item in images.items() if item.session == session)
        self._waiting.update((stamp, item) for stamp, item in waiting.items() if item.session == session)

    def _clear(self) -> None:
        self._images: dict[int, Image] = {}
        self._waiting: dict[int, LaserScan] = {}
        self._long_poses: dict[int, FloatArray] = {}
        self._scans: dict[int, _Scan] = {}
        self._last: _Scan | None = None
        self._next_number = 0
        self._unrefined: list[tuple[IntArray, FloatArray]] = []

    # Poses and colour.

    def _take_poses(self, window: WindowPoses) -> None:
        """Give every frame of the window its pose; colour the scans that are new."""
        short = window.kinds == FrameKind.SHORT.value
        for index in np.flatnonzero(~short):
            self._long_poses[int(window.stamps[index])] = window.T_map_camera[index]
        views = self._views()
        for index in np.flatnonzero(short):
            stamp = int(window.stamps[index])
            item = self._scans.get(stamp) or self._begin(stamp, window.T_map_camera[index], bool(window.redundant[index]), views)
            if item is not None:
                item.T_map_camera, item.final = window.T_map_camera[index], bool(window.final[index])
                item.redundant = bool(window.redundant[index])

    def _begin(self, stamp: int, T_map_camera: FloatArray, redundant: bool, views: IntArray) -> _Scan | None:
        """Return the scan of a stamp that has its first pose; None where there is none."""
        scan = self._waiting.pop(stamp, None)
        if scan is None or scan.session != self._session:
            self.counters.add("poses_without_scan")
            return None
        if len(scan) == 0:
            self.counters.add("scans_empty")
            return None
        keep = away_from_edges(scan.points, scan.sigma, self.config.entry)
        self.counters.add("points_at_edges", int(len(keep) - keep.sum()))
        scan = _subset(scan, keep)
        colours = np.full((len(scan), 3), np.nan, np.float32) if redundant else self._colour(scan, T_map_camera, views)
        item = self._scans[stamp] = _Scan(scan, self._next_number, T_map_camera, colours)
        self._next_number += 1
        return item

    def _views(self) -> IntArray:
        """Return the stamps of the long images that have a pose, ascending."""
        known = [stamp for stamp in self._long_poses if stamp in self._images and self._images[stamp].session == self._session]
        return np.array(sorted(known), np.int64)

    def _colour(self, scan: LaserScan, T_map_camera: FloatArray, views: IntArray) -> Float32Array:
        """Return the colours (N, 3) of a scan from the long images before and after it."""
        at = int(np.searchsorted(views, scan.stamp_ns))
        gap = int(self.config.colour_gap_s * NANOSECONDS)
        near = [int(stamp) for stamp in views[max(at - 1, 0) : at + 1] if abs(int(stamp) - scan.stamp_ns) <= gap]
        if not near:
            self.counters.add("scans_without_image")
        points = transform(T_map_camera, scan.points)
        return colour_points(self._camera, points, [(self._images[stamp].pixels, self._long_poses[stamp]) for stamp in near])

    # The map.

    def _enter_final(self) -> IntArray:
        """Enter the scans that have left the window; return the map points they became or joined, ascending."""
        touched = [np.empty(0, np.int64)]
        for before, item, after in self._final_scans():
            touched.append(self._enter(item, [other for other in (before, after) if other is not None]))
            self._last = item
        return np.unique(np.concatenate(touched))

    def _final_scans(self) -> Iterator[tuple[_Scan | None, _Scan, _Scan | None]]:
        """Yield the final scans that add something, in order of time, with those before and after them."""
        useful = [self._scans[stamp] for stamp in sorted(self._scans) if not self._scans[stamp].redundant]
        self.counters.add("scans_redundant", sum(item.final and item.redundant for item in self._scans.values()))
        for index, item in enumerate(useful):
            if item.final:
                yield self._last, item, useful[index + 1] if index + 1 < len(useful) else None

    def _enter(self, item: _Scan, beside: list[_Scan]) -> IntArray:
        """Merge one scan into the map; return the map points (N,) it touched."""
        config, points = self.config, item.points
        others = np.concatenate([np.empty((0, 3)), *(other.points for other in beside)])
        normals, planarity = stripe_normals(points, others, item.viewpoint, config.map.normal_radius, config.map.min_planarity)
        backed = supported(points, others, config.entry.support_radius)
        steep = ~not_grazing(points, normals, item.viewpoint, config.entry.max_incidence_deg)
        self.counters.add("points_unsupported", int((~backed).sum()))
        self.counters.add("points_grazing", int((backed & steep).sum()))
        keep = backed & ~steep
        stripe = Stripe(
            item.scan.stamp_ns, item.number, item.viewpoint, points[keep], normals[keep], planarity[keep],
            item.colours[keep], item.scan.sigma[keep],
        )  # fmt: skip
        target = self.map.insert(stripe)
        self.counters.add("scans_entered")
        self._refine(target, item.viewpoint)
        return target

    def _refine(self, target: IntArray, viewpoint: FloatArray) -> None:
        """Fit the normals around a stripe again once its later neighbours are there too."""
        self._unrefined.append((target, viewpoint))
        if len(self._unrefined) > _REFINE_DELAY:
            which, seen_from = self._unrefined.pop(0)
            self.map.refine_normals(np.unique(which), seen_from)

    def _constrain(self, window: WindowPoses) -> MapConstraints | None:
        """Return the correspondences of the scans that the window still holds."""
        inside = [
            WindowScan(item.scan, item.number, item.T_map_camera, item.colours, np.zeros((len(item.scan), 3), np.float32))
            for item in self._scans.values()
            if not item.final and not item.redundant
        ]
        return associate(self.map, inside, window.stamp_ns, self.config.association, self.counters, self._session)

    # Output and housekeeping.

    def _live_cloud(self, stamp_ns: int) -> PointCloud | None:
        """Return the stripes that have not been shown yet, coloured, where they are believed to be now."""
        fresh = [item for item in self._scans.values() if not item.published and not item.redundant]
        if not fresh:
            return None
        for item in fresh:
            item.published = True
        points = np.concatenate([item.points for item in fresh]).astype(np.float32)
        return PointCloud(stamp_ns, points, to_bytes(np.concatenate([item.colours for item in fresh])), session=self._session)

    def _release(self, window: WindowPoses) -> None:
        """Forget what no later window can ask for."""
        for stamp in [stamp for stamp, item in self._scans.items() if item.final]:
            del self._scans[stamp]
        gap = int(self.config.colour_gap_s * NANOSECONDS)
        newest = int(window.stamps[-1]) if len(window) else window.stamp_ns
        for stamp in [stamp for stamp in self._images if stamp < newest - gap]:
            del self._images[stamp]
        for stamp in [stamp for stamp in self._long_poses if stamp < newest - gap]:
            del self._long_poses[stamp]

    def _forget(self, items: dict[int, Image] | dict[int, LaserScan], before_ns: int, counter: str) -> None:
        old = [stamp for stamp in items if stamp < before_ns]
        for stamp in old:
            del items[stamp]
        self.counters.add(counter, len(old))


def _subset(scan: LaserScan, keep: BoolArray) -> LaserScan:
    return LaserScan(scan.stamp_ns, scan.points[keep], scan.pixels[keep], scan.intensity[keep], scan.sigma[keep], scan.session)
