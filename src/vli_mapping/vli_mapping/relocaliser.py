"""Where this session is in the map: after a loss, or in the map of an earlier session.

A wrong answer is far worse than a late one: the neighbouring key of a keyboard looks much the same. So an answer must be
supported by the features of all views so far, by a margin to the best that is elsewhere; the window's own stripes must lie on the
map, to which they are aligned as in eq. (4), and agree with it in normal and colour; and the images must look like those that the
map remembers.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vli_common.arrays import ByteArray, FloatArray
from vli_common.camera import CameraModel
from vli_common.geometry import inverse, transform
from vli_common.types import Counters
from vli_mapping.alignment import Alignment, align_session
from vli_mapping.features import THUMBNAIL_WIDTH, ImageFeatures, describe_image
from vli_mapping.keyframe import MapKeyframe
from vli_mapping.place_recognition import Evidence, PlaceIndex
from vli_mapping.point_map import PointMap
from vli_mapping.registration import ICP_VOXEL_M, Surface, surface_of
from vli_mapping.scan_window import PosedScan

_VIEWS, _REMEMBERED = 6, 64
"""Views that speak, the newest, since the session drifts; and stamps of which it is remembered that they have."""
_MIN_SUPPORT, _FIRST_SUPPORT, _MARGIN = 40, 60, 2.0
"""Features of each view that agree with an answer, on average, and of all views together; and how many times those that agree
with one elsewhere. On a keyboard some 10 of a view agree with a wrong key, and 50 to 250 with the right one."""
_ELSEWHERE_M = 5e-3
_MAX_TILT = float(np.radians(3.0))
"""Between two frames that gravity levels."""
_MIN_SCANS, _MIN_OVERLAP, _MIN_AGREEING = 20, 300, 0.8
"""Stripes: with fewer, the window has only just begun; their points that the map has, one a voxel; share of these that agrees."""
_MAX_MOVE_M = 3e-3
"""By which the stripes may correct what the features say."""
_MIN_LIKENESS, _MIN_SAMPLES = 0.6, 200
_ROOM_M = 3e-3
_SIGMA_FLOOR_M, _MAX_SIGMA_M = 5e-5, 2e-4
"""Of the map itself, on top of what the residuals say; and beyond which an answer waits for more views."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a session is in the map.

    Args:
        T_map_session: (4, 4).
        sigma_m: of the position.
        support: features that agree.
        agreeing: share of the stripes' points on the map that agree with it in place, normal and colour.
        likeness: correlation of the images with those that the map remembers.
    """

    T_map_session: FloatArray
    sigma_m: float
    support: int
    agreeing: float
    likeness: float


@dataclass(frozen=True, slots=True)
class View:
    """One image of the session: pixels (H, W[, 3]), and its pose T_session_camera (4, 4)."""

    stamp_ns: int
    pixels: ByteArray
    T_session_camera: FloatArray


class _InDoubtError(Exception):
    """Why no answer is given, as the counter names it."""


class Relocaliser:
    """Gathers what the views of an unlocated session say, until it is enough.

    Args:
        point_map: to find the session in; it does not change meanwhile.
        keyframes: of that map.
        camera: of the views.
        is_levelled: whether gravity levels both frames.
        counters: of the stage; every answer that was not given is counted there.
    """

    def __init__(
        self,
        point_map: PointMap,
        keyframes: Sequence[MapKeyframe],
        camera: CameraModel,
        is_levelled: bool,
        counters: Counters,
    ) -> None:
        self._map, self._keyframes, self._camera = point_map, keyframes, camera
        self._is_levelled, self._counters = is_levelled, counters
        self._index = PlaceIndex(keyframes, camera)
        self._evidence: list[Evidence] = []
        self._thumbnails: dict[int, ByteArray] = {}
        self._seen: deque[int] = deque(maxlen=_REMEMBERED)
        self._hypotheses: list[FloatArray] = []

    def has_seen(self, stamp_ns: int) -> bool:
        """Return True where a view of this stamp has been taken."""
        return stamp_ns in self._seen

    def add_view(self, view: View) -> None:
        """Take one more view."""
        features: ImageFeatures = describe_image(view.pixels)
        evidence, hypotheses = self._index.match(view.stamp_ns, features, view.T_session_camera)
        self._evidence = sorted([*self._evidence, evidence], key=lambda item: item.stamp_ns)[-_VIEWS:]
        self._thumbnails[view.stamp_ns] = features.thumbnail
        self._thumbnails = {item.stamp_ns: self._thumbnails[item.stamp_ns] for item in self._evidence}
        self._seen.append(view.stamp_ns)
        self._hypotheses = [*self._hypotheses, *filter(self._is_level, hypotheses)][-4 * _VIEWS :]
        self._counters.add("relocalisation_views")

    def locate(self, scans: Sequence[PosedScan]) -> Place | None:
        """Return where the session is, if features, stripes and images leave no doubt.

        Args:
            scans: of the session, with poses in its frame.
        """
        if not scans:
            return None
        try:
            return self._located(scans)
        except _InDoubtError as doubt:
            self._counters.add(f"relocalisation_{doubt}")
            return None

    def _located(self, scans: Sequence[PosedScan]) -> Place:
        T, support = self._most_supported()
        if len(scans) < _MIN_SCANS:
            raise _InDoubtError("few_scans")
        found = self._aligned(scans, T)
        if found.fit.overlap < _MIN_OVERLAP:
            raise _InDoubtError("off_the_map")
        if found.fit.agreeing < _MIN_AGREEING or self._shift(found.T_map_session, T) > _MAX_MOVE_M:
            raise _InDoubtError("stripes_disagree")
        if found.sigma_m > _MAX_SIGMA_M:
            raise _InDoubtError("uncertain")
        if not self._is_level(found.T_map_session):
            raise _InDoubtError("tilted")
        likeness = self._likeness(scans, found.T_map_session)
        if likeness < _MIN_LIKENESS:
            raise _InDoubtError("images_differ")
        sigma = float(np.hypot(found.sigma_m, _SIGMA_FLOOR_M))
        return Place(found.T_map_session, sigma, support, found.fit.agreeing, likeness)

    def _most_supported(self) -> tuple[FloatArray, int]:
        """Return the hypothesis that most features agree with, and how many.

        Raises:
            _InDoubtError: they are few, or one elsewhere rivals.
        """
        ranked = [(self._index.support(self._evidence, T), T) for T in self._hypotheses]
        if not ranked:
            raise _InDoubtError("nothing_alike")
        support, T = max(ranked, key=lambda item: item[0])
        if support < max(_MIN_SUPPORT * len(self._evidence), _FIRST_SUPPORT):
            raise _InDoubtError("few_features")
        elsewhere = max((other for other, rival in ranked if self._shift(rival, T) > _ELSEWHERE_M), default=0)
        if _MARGIN * elsewhere > support:
            raise _InDoubtError("ambiguous")
        return T, support

    def _shift(self, first: FloatArray, second: FloatArray) -> float:
        """Return how far apart two hypotheses put what the newest view sees, metres."""
        T_session_camera = self._evidence[-1].T_session_camera
        depth = float(np.median([item.depth for item in self._keyframes]))
        corners = np.array([[x, y, 1.0] for x in (-0.3, 0.3) for y in (-0.3, 0.3)]) * depth
        seen = transform(T_session_camera, corners)
        return float(np.linalg.norm(transform(first, seen) - transform(second, seen), axis=1).max())

    def _is_level(self, T_map_session: FloatArray) -> bool:
        return not self._is_levelled or bool(T_map_session[2, 2] > np.cos(_MAX_TILT))

    def _aligned(self, scans: Sequence[PosedScan], T_map_session: FloatArray) -> Alignment:
        """Return how the session lies on the map, near a hypothesis."""
        source = _stripes(scans)
        target = _around(self._map, transform(T_map_session, source.points))
        if min(len(source.points), len(target.points)) < _MIN_OVERLAP:
            raise _InDoubtError("off_the_map")
        return align_session(target, source, self._evidence, T_map_session)

    def _likeness(self, scans: Sequence[PosedScan], T_map_session: FloatArray) -> float:
        """Return the median correlation of views with what the map remembers of the same spots; 0 where nothing is shared."""
        spots = np.concatenate(
            [item.probe(100).points @ item.T_map_camera[:3, :3].T + item.T_map_camera[:3, 3] for item in scans]
        )
        values = []
        for item in self._evidence:
            now = self._sample(self._thumbnails[item.stamp_ns], item.T_session_camera, spots)
            near = self._nearest_keyframe(T_map_session @ item.T_session_camera)
            then = self._sample(near.thumbnail, near.T_map_camera, transform(T_map_session, spots))
            both = np.isfinite(now) & np.isfinite(then)
            if both.sum() >= _MIN_SAMPLES:
                values.append(float(np.corrcoef(now[both], then[both])[0, 1]))
        return float(np.median(values)) if values else 0.0

    def _nearest_keyframe(self, T_map_camera: FloatArray) -> MapKeyframe:
        apart = [float(np.linalg.norm(item.T_map_camera[:3, 3] - T_map_camera[:3, 3])) for item in self._keyframes]
        return self._keyframes[int(np.argmin(apart))]

    def _sample(self, thumbnail: ByteArray, T_frame_camera: FloatArray, spots: FloatArray) -> FloatArray:
        """Return what a thumbnail shows of spots (N, 3), NaN where they are outside."""
        scale = min(1.0, THUMBNAIL_WIDTH / self._camera.width)
        pixels = (self._camera.project(transform(inverse(T_frame_camera), spots)) + 0.5) * scale - 0.5
        height, width = thumbnail.shape
        with np.errstate(invalid="ignore"):
            inside = ((pixels >= 0) & (pixels <= [width - 1, height - 1])).all(axis=1)
        values = np.full(len(spots), np.nan)
        column, row = np.rint(pixels[inside]).astype(np.int64).T
        values[inside] = thumbnail[row, column]
        return values


def _stripes(scans: Sequence[PosedScan]) -> Surface:
    """Return the solid points of scans, one a voxel."""
    points = np.concatenate([item.points[item.solid] for item in scans])
    normals = np.concatenate([item.map_normals[item.solid] for item in scans])
    colours = np.concatenate([item.colours[item.solid] for item in scans])
    return surface_of(points, normals, colours, np.ones(len(points), np.float32), ICP_VOXEL_M)


def _around(point_map: PointMap, points: FloatArray) -> Surface:
    """Return what of the map is about some points (N, 3)."""
    c, rows = point_map.columns, point_map.rows
    if not len(points) or not rows:
        return Surface(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3), np.float32))
    low, high = points.min(axis=0) - _ROOM_M, points.max(axis=0) + _ROOM_M
    position = c.position[:rows]
    inside = (c.weight[:rows] > 0) & c.solid[:rows]
    for axis in range(3):
        inside &= (position[:, axis] > low[axis]) & (position[:, axis] < high[axis])
    which = np.flatnonzero(inside)
    return surface_of(c.position[which], c.normal[which], c.colour[which], c.weight[which], ICP_VOXEL_M)
