"""The mapping stage: windows of poses in; map, constraints on the window, and live cloud out."""

from __future__ import annotations

from collections import deque

import numpy as np

from vli_common.arrays import FloatArray, IntArray
from vli_common.calibration import Calibration
from vli_common.types import Counters, Image, LaserScan, MappingOutput, Mode, PointCloud, WindowPoses
from vli_mapping.association import associate
from vli_mapping.config import AS_SEEN, MappingConfig
from vli_mapping.contradiction import contradict
from vli_mapping.light import Light, LightEstimator
from vli_mapping.point_map import PointMap, Stripe, to_bytes
from vli_mapping.scan_window import PosedScan, ScanWindow
from vli_mapping.snapshot import Snapshot, restore

_REFINE_DELAY = 3
"""Scans that enter after one before its normals are fitted again: by then the surface around it is there."""


class Mapper:
    """Scans enter the map with their final poses, after the solve; those still in the window are related to the map, eq. (4).

    Args:
        calibration: of the camera.
        config: see :class:`MappingConfig`.
        mode: whether there is a laser, and whether the window is aligned to the map.
    """

    def __init__(self, calibration: Calibration, config: MappingConfig | None = None, mode: Mode = Mode.VLI_SLAM) -> None:
        self.config = config or MappingConfig()
        self.counters = Counters()
        self.constrains = mode.uses_map
        """Whether the window is aligned to the map; may be switched at any time."""
        self.map = PointMap(self.config.map)
        self._uses_laser = mode.uses_laser
        self._window = ScanWindow(calibration.camera, self.config, self.counters)
        self._unrefined: list[tuple[IntArray, FloatArray]] = []
        self._light = LightEstimator()
        self._is_foreign = False
        self._entering: deque[PosedScan] = deque()
        self._touched: list[IntArray] = []

    def add_image(self, image: Image) -> None:
        """Take a long image, for colour."""
        if self._uses_laser:
            self._window.add_image(image)

    def add_scan(self, scan: LaserScan) -> None:
        """Take the stripe of a short frame; it waits for its pose. One that has its last pose enters the map.

        As many scans leave the window at a keyframe as came since the last: so no frame has to enter them all.
        """
        self._window.add_scan(scan)
        self._enter_next()

    def add_window(self, window: WindowPoses) -> MappingOutput:
        """Take the poses after a solve; return constraints for the next one, the newest stripes, and what is new in the map.

        The scans that leave the window enter with the scans that come, at the latest before the next window; at once where
        nothing stays.
        """
        session = window.session
        if session < self._window.session:
            self.counters.add("windows_of_old_session")
            return MappingOutput()
        if session > self._window.session:
            self.reset(session)
        self.settle()
        self._window.update(window)
        self._let_go()
        if window.final.all():
            self.settle()
        constraints = None
        if self.constrains and not self._is_foreign:
            staying = self._window.staying()
            constraints = associate(self.map, staying, window.stamp_ns, self.config.association, self.counters, session)
        cloud = _live_cloud(self._window.unpublished(), window.stamp_ns, session)
        self._window.release(window)
        touched = self._entered()
        update = (
            self.map.cloud(touched, window.stamp_ns, session, self._light.latest, self.config.colour == AS_SEEN)
            if len(touched)
            else None
        )
        return MappingOutput(constraints, cloud, update)

    def cloud(self, max_points: int | None = None, stamp_ns: int = 0, session: int = 0) -> PointCloud:
        """Return the map, thinned to ``max_points`` where given; colours as the config asks for."""
        self.settle()
        light, as_seen = self.light(), self.config.colour == AS_SEEN
        if max_points is None:
            return self.map.cloud(None, stamp_ns, session, light, as_seen)
        return self.map.thinned(max_points, stamp_ns, session, light, as_seen)

    def light(self) -> Light | None:
        """Return the light on board and the lens as all scans so far tell of them; None while they tell too little."""
        return self._light.fit()

    def settle(self) -> None:
        """Enter all scans that have left the window."""
        while self._entering:
            self._enter_next()

    def adopt(self, snapshot: Snapshot) -> None:
        """Take a map of an earlier session in place of this one's.

        Poses of now and of then share no frame: until the next reset, no scan enters, and none is related to the map.
        """
        self.settle()
        self._touched.clear()
        self.map = restore(snapshot, self.config.map)
        self._light = LightEstimator(snapshot.light)
        self._unrefined.clear()
        self._is_foreign = True

    def resume(self, snapshot: Snapshot) -> None:
        """Go on with a map of this very session, which a mapper before this one has saved: their poses share a frame.

        The few scans that have entered the map of this one so far are dropped with it.
        """
        self.settle()
        self._touched.clear()
        self.map = restore(snapshot, self.config.map)
        self._light = LightEstimator(snapshot.light)
        self._unrefined.clear()
        self._window.count_from(len(snapshot.views))

    def waiting(self) -> list[Stripe]:
        """Return the scans of the window as they would enter the map now, in order of time."""
        if self._is_foreign:
            return []
        return [_stripe(item) for item in self._window.staying() if item.described]

    def reset(self, session: int) -> None:
        """Drop all that belongs to another session, and start a new map: poses of two sessions share no frame.

        The old map stays intact for whoever holds it.
        """
        self.counters.add("sessions")
        self.settle()
        self._touched.clear()
        self._is_foreign = False
        if len(self.map):
            self.map = PointMap(self.config.map)
        self._unrefined.clear()
        self._light = LightEstimator()
        self._window = self._window.successor(session)

    def _let_go(self) -> None:
        """Line up the scans that leave the window, and learn what they tell of the light."""
        leaving = list(self._window.leaving())
        if self._is_foreign:
            self.counters.add("scans_beside_a_loaded_map", len(leaving))
            return
        if self._light.is_due():
            self._light.add(self._window.sightings())
        self._entering.extend(leaving)

    def _enter_next(self) -> None:
        """Enter the oldest scan that waits, if one does."""
        if self._entering:
            self._touched.append(self._enter(self._entering.popleft()))

    def _entered(self) -> IntArray:
        """Return the map points that scans became or joined since the last call, ascending."""
        touched = self.map.alive(np.unique(np.concatenate([np.empty(0, np.int64), *self._touched])))
        self._touched.clear()
        return touched

    def _enter(self, item: PosedScan) -> IntArray:
        """Merge one scan into the map; return the map points (K,) it touched."""
        stripe, left = contradict(self.map, _stripe(item))
        target = self.map.insert(stripe)
        touched = np.unique(target[target >= 0])
        self.counters.add("scans_entered")
        self.counters.add("points_entered", int((target >= 0).sum()))
        self.counters.add("points_contradicted", left)
        self.counters.add("points_blurred", int((~item.usable).sum()))
        self.counters.add("points_doubtful_dropped", int((target < 0).sum()))
        self._refine(touched, item.viewpoint)
        return touched

    def _refine(self, touched: IntArray, viewpoint: FloatArray) -> None:
        """Fit the normals around a stripe again once its later neighbours are there too."""
        self._unrefined.append((touched, viewpoint))
        if len(self._unrefined) > _REFINE_DELAY:
            self.map.refine_normals(*self._unrefined.pop(0))


def _stripe(item: PosedScan) -> Stripe:
    """Return the usable points of a scan as the map takes them."""
    use = item.usable
    return Stripe(
        stamp_ns=item.scan.stamp_ns,
        number=item.number,
        T_map_camera=item.T_map_camera,
        points=item.points[use],
        normals=item.map_normals[use],
        planarity=item.planarity[use],
        colours=item.colours[use],
        sigma=item.scan.sigma[use],
        solid=item.solid[use],
    )


def _live_cloud(scans: list[PosedScan], stamp_ns: int, session: int) -> PointCloud | None:
    """Return the stripes of scans, coloured, where they are believed to be now; None where there are none."""
    if not scans:
        return None
    points = np.concatenate([item.points for item in scans]).astype(np.float32)
    return PointCloud(stamp_ns, points, to_bytes(np.concatenate([item.colours for item in scans])), session=session)
