"""Whether the poses of the window are in the map, and what is done until they are.

After a loss the window is where the IMU has carried it, and in the map of an earlier session it is anywhere. Until it is found no
scan enters; those that leave the window are held back, and enter moved to where the session turns out to be.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from vli_common.camera import CameraModel
from vli_common.types import Counters, Image, Relocalisation, WindowPoses
from vli_mapping.point_map import PointMap
from vli_mapping.relocaliser import Relocaliser, View
from vli_mapping.scan_window import PosedScan

_MAX_HELD = 300
"""Scans that wait for their place: ten seconds. What is older has drifted, and is scanned again soon enough."""
_MAX_VIEWS = 2
"""New views for one window: each takes as long as several frames."""
_PATIENCE = 5
"""Windows until an answer that had no effect is given again."""
_ALIGNED_SCANS = 120


class Whereabouts:
    """Follows the placements of the session, and looks for its place in the map where that is not known.

    Args:
        camera: of the long images.
        is_levelled: whether gravity levels every session.
        counters: of the stage.
    """

    def __init__(self, camera: CameraModel, is_levelled: bool, counters: Counters) -> None:
        self.is_known = True
        """Whether the poses of the newest window are in the map."""
        self._camera, self._is_levelled, self._counters = camera, is_levelled, counters
        self._placement = self._first_in_map = 0
        self._held: deque[PosedScan] = deque()
        self._relocaliser: Relocaliser | None = None
        self._answer: Relocalisation | None = None
        self._windows_since = 0

    def begin_search(self) -> None:
        """Take notice that the map is not of this session: no pose so far is in it."""
        self._first_in_map = self._placement + 1
        self.drop_held()
        self._relocaliser, self._answer, self.is_known = None, None, False

    def follow(self, window: WindowPoses) -> list[PosedScan]:
        """Take the placement of the next window; return the scans held back that are in the map now, in order of time."""
        released: list[PosedScan] = []
        if window.placement != self._placement:
            self._placement = window.placement
            if self._answer is not None and window.located:
                released = self._moved(self._answer)
                self._counters.add("relocalisations_heeded")
            self.drop_held()
            self._relocaliser, self._answer = None, None
        self.is_known = window.located and window.placement >= self._first_in_map
        return released

    def hold(self, scans: Sequence[PosedScan]) -> None:
        """Take scans that have left the window without a place in the map; the oldest are dropped where they are many."""
        self._held.extend(scans)
        while len(self._held) > _MAX_HELD:
            self._held.popleft()
            self._counters.add("scans_unlocated")

    def seek(
        self, window: WindowPoses, keyframes: Sequence[tuple[Image, int]], staying: Sequence[PosedScan], point_map: PointMap
    ) -> Relocalisation | None:
        """Return where the session is in the map, once that is beyond doubt.

        Args:
            window: the newest.
            keyframes: images of its keyframes, and their rows in it, in order of time.
            staying: its scans.
            point_map: to find it in.
        """
        if not point_map.keyframes:
            self._counters.add("relocalisation_without_keyframes")
            return None
        if self._answer is not None and self._windows_since < _PATIENCE:
            self._windows_since += 1
            return None
        if self._relocaliser is None:
            self._relocaliser = Relocaliser(point_map, point_map.keyframes, self._camera, self._is_levelled, self._counters)
        seeker = self._relocaliser
        fresh = [item for item in keyframes if not seeker.has_seen(item[0].stamp_ns)][-_MAX_VIEWS:]
        for image, row in fresh:
            seeker.add_view(View(image.stamp_ns, image.pixels, window.T_map_camera[row]))
        place = seeker.locate([*self._held, *staying][-_ALIGNED_SCANS:]) if fresh else None
        if place is None:
            return None
        self._windows_since = 0
        self._answer = Relocalisation(window.stamp_ns, place.T_map_session, place.sigma_m, window.session)
        return self._answer

    def drop_held(self) -> None:
        """Give up what was held back."""
        self._counters.add("scans_unlocated", len(self._held))
        self._held.clear()

    def _moved(self, answer: Relocalisation) -> list[PosedScan]:
        scans = list(self._held)
        for item in scans:
            item.T_map_camera = np.ascontiguousarray(answer.T_map_session @ item.T_map_camera)
        self._held.clear()
        return scans
