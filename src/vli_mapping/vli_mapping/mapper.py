"""The mapping stage: windows of poses in; map, constraints on the window, and live cloud out."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from vli_common.arrays import FloatArray, IntArray
from vli_common.calibration import Calibration
from vli_common.types import Counters, Image, LaserScan, MappingOutput, Mode, PointCloud, WindowPoses
from vli_mapping.albedo import finished_cloud
from vli_mapping.association import associate
from vli_mapping.config import AS_SEEN, MappingConfig
from vli_mapping.contradiction import contradict
from vli_mapping.light import Light, LightEstimator
from vli_mapping.map_file import load_map
from vli_mapping.map_keyframes import KeyframeIntake
from vli_mapping.photographs import Album, Photograph, develop
from vli_mapping.point_map import PointMap, Stripe, to_bytes
from vli_mapping.scan_window import PosedScan, ScanWindow
from vli_mapping.scene_change import SceneChange
from vli_mapping.snapshot import Snapshot, restore
from vli_mapping.whereabouts import Whereabouts

_LONG_AGO_NS = -(1 << 62)
"""Stamp of what an earlier session brought: it is independent of every window, whatever the clocks say."""
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
        self._change = SceneChange()
        self._light = LightEstimator()
        self._entering: deque[PosedScan] = deque()
        self._touched: list[IntArray] = []
        self._entered_ns = 0
        self._intake, self._album = KeyframeIntake(calibration.camera), Album()
        self.camera, self._is_levelled = calibration.camera, mode.uses_imu
        self._whereabouts = self._new_whereabouts()
        self._prior = load_map(Path(self.config.prior_map)) if self.config.prior_map else None
        if self._prior is not None:
            self.adopt(self._prior)

    def add_image(self, image: Image) -> None:
        """Take a long image, for colour and to find the way back by; meanwhile the map learns a keyframe, if one is due."""
        if self._uses_laser:
            self._window.add_image(image)
            self._intake.learn(self.map, self._entered_ns)

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
        self._entering.extend(self._whereabouts.follow(window))
        self._window.update(window)
        self._let_go(window)
        if window.final.all():
            self.settle()
            self._intake.learn(self.map, None)
        constraints = relocalisation = None
        staying = self._window.staying()
        if not self.is_located:
            keyframes = self._window.keyframe_images(window)
            relocalisation = self._whereabouts.seek(window, keyframes, staying, self.map)
        elif self.constrains:
            constraints = associate(self.map, staying, window.stamp_ns, self.config.association, self.counters, session)
        cloud = _live_cloud(self._window.unpublished(), window.stamp_ns, session)
        self._window.release(window)
        touched = self._entered()
        update = (
            self.map.cloud(touched, window.stamp_ns, session, self._light.latest, self.config.colour == AS_SEEN)
            if len(touched)
            else None
        )
        return MappingOutput(constraints, cloud, update, relocalisation)

    @property
    def session(self) -> int:
        """Of the map."""
        return self._window.session

    @property
    def is_located(self) -> bool:
        """False while the window's place in the map is not known: after a loss, or in the map of an earlier session."""
        return self._whereabouts.is_known or not len(self.map)

    @property
    def hint(self) -> str:
        """What to do, in words; empty where nothing is wrong."""
        return self._change.hint if self.is_located else "the place in the map is not known yet: go over a part that is mapped"

    def cloud(self, max_points: int | None = None, stamp_ns: int = 0, session: int = 0) -> PointCloud:
        """Return the map, colours as the config asks for.

        Thinned to ``max_points`` where given, each colour then by itself, and in the light as it was found last.
        """
        self.settle()
        as_seen = self.config.colour == AS_SEEN
        if max_points is None:
            return finished_cloud(self.map, self.light(), as_seen, stamp_ns, session)
        return self.map.thinned(max_points, stamp_ns, session, self._light.latest, as_seen)

    def light(self) -> Light | None:
        """Return the light on board and the lens as all scans so far tell of them; None while they tell too little."""
        return self.light_fit()()

    def light_fit(self) -> Callable[[], Light | None]:
        """Return what finds the light, for another thread: it takes a tenth of a second, in which scans may go on entering."""
        return self._light.pending()

    def photographs(self) -> tuple[Photograph, ...]:
        """Return the images that the map does not have the albedo of yet."""
        return tuple(self._album.photographs)

    def develop(self) -> None:
        """Let the map have what the photographs say of albedo, and forget these: once, when a scan is at its end."""
        self.settle()
        develop(self.map, self.light(), self.camera, self._album.photographs)
        self._album.clear()

    def settle(self) -> None:
        """Enter all scans that have left the window."""
        while self._entering:
            self._enter_next()

    def adopt(self, snapshot: Snapshot) -> None:
        """Take a map of an earlier session in place of this one's.

        Poses of now and of then share no frame: until the session is found in that map, no scan enters or is related to it.
        """
        self._replace(snapshot)
        self.map.columns.entered_ns[: self.map.rows] = _LONG_AGO_NS
        self._whereabouts.begin_search()

    def resume(self, snapshot: Snapshot) -> None:
        """Go on with a map of this very session, which a mapper before this one has saved: their poses share a frame.

        The few scans that have entered the map of this one so far are dropped with it.
        """
        self._replace(snapshot)

    def waiting(self) -> list[Stripe]:
        """Return the scans of the window as they would enter the map now, in order of time."""
        if not self.is_located:
            return []
        return [_stripe(item) for item in self._window.staying() if item.described]

    def reset(self, session: int) -> None:
        """Drop all that belongs to another session, and start a new map, or with the prior one: sessions share no frame.

        The old map stays intact for whoever holds it.
        """
        self.counters.add("sessions")
        self.settle()
        self._touched.clear()
        if len(self.map):
            self.map = PointMap(self.config.map)
        self._unrefined.clear()
        self._change.clear()
        self._intake.clear()
        self._album.clear()
        self._light = LightEstimator()
        self._window = self._window.successor(session)
        self._whereabouts.drop_held()
        self._whereabouts = self._new_whereabouts()
        if self._prior is not None:
            self.adopt(self._prior)

    def _new_whereabouts(self) -> Whereabouts:
        return Whereabouts(self.camera, self._is_levelled, self.counters)

    def _replace(self, snapshot: Snapshot) -> None:
        """Take another map in place of this one; scans are numbered on from those that made it."""
        self.settle()
        self._touched.clear()
        self.map = restore(snapshot, self.config.map)
        self._light = LightEstimator(snapshot.light)
        self._unrefined.clear()
        self._change.clear()
        self._intake.clear()
        self._album.clear()
        self._window.count_from(len(snapshot.views))

    def _let_go(self, window: WindowPoses) -> None:
        """Line up the scans and keyframes that leave the window, and learn what they tell of the light."""
        leaving = list(self._window.leaving())
        if not self.is_located:
            self._whereabouts.hold(leaving)
            return
        if self._light.is_due():
            self._light.add(self._window.sightings())
        self._entering.extend(leaving)
        if leaving:
            depth = float(np.median([np.median(item.scan.points[:, 2]) for item in leaving]))
            for image, row in self._window.keyframe_images(window):
                if window.final[row]:
                    self._intake.offer(image, window.T_map_camera[row], depth, self.map)
                    self._album.offer(image, window.T_map_camera[row], depth)

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
        seen = _stripe(item)
        stripe, left, with_them = contradict(self.map, seen)
        self._change.add(seen.solid, seen.solid & ~stripe.solid)
        target = self.map.insert(stripe)
        touched = np.unique(target[target >= 0])
        self._entered_ns = item.scan.stamp_ns
        self.counters.add("scans_entered")
        self.counters.add("points_entered", int((target >= 0).sum()))
        self.counters.add("points_contradicted", left)
        self.counters.add("points_left_with_piece", with_them)
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
