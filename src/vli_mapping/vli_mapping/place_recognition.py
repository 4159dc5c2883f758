"""Where in the map an image was taken, by features: hypotheses of single views, and what all views together say of each.

A feature looks for its like among those of all keyframes of the map; the keyframes with the most votes are matched one by one,
and each gives a pose by PnP and RANSAC (:mod:`vli_mapping.reprojection`). Things repeat (a keyboard's keys every 19 mm), so a
hypothesis counts by the matches of all views that agree with it, and against the best that is somewhere else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from vli_common.arrays import ByteArray, FloatArray, IntArray
from vli_common.camera import CameraModel
from vli_common.geometry import inverse, transform
from vli_mapping.features import ImageFeatures
from vli_mapping.keyframe import MapKeyframe
from vli_mapping.reprojection import MIN_MATCHES, TOLERANCE_PX, Matches, errors_px, joined, resect

_MAX_DISTANCE = 64
"""Bits, of 256, in which descriptors of the same corner may differ."""
_NEIGHBOURS, _KEYFRAMES = 6, 6
_VOTERS = 150
"""Features of a map keyframe that vote, the strongest: their number decides what a large map costs."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """Matches of one view with the map.

    Args:
        stamp_ns: of the view.
        T_session_camera: (4, 4).
        matches: M of them; a feature that matches several keyframes is there several times.
        features: (M,), which feature each is.
    """

    stamp_ns: int
    T_session_camera: FloatArray
    matches: Matches
    features: IntArray


class PlaceIndex:
    """Finds the features of an image among those of a map's keyframes.

    Args:
        keyframes: of the map.
        camera: of the images to come.
    """

    def __init__(self, keyframes: Sequence[MapKeyframe], camera: CameraModel) -> None:
        self._keyframes = keyframes
        self._camera = camera
        voters = [item.descriptors[:_VOTERS] for item in keyframes]
        self._owner = np.repeat(np.arange(len(voters)), [len(item) for item in voters])
        self._descriptors = np.concatenate(voters) if voters else np.empty((0, 32), np.uint8)

    def __len__(self) -> int:
        return len(self._keyframes)

    def match(self, stamp_ns: int, features: ImageFeatures, T_session_camera: FloatArray) -> tuple[Evidence, list[FloatArray]]:
        """Return the matches of an image with the keyframes most like it, and hypotheses T_map_session (4, 4) from each."""
        features, rays = features.with_rays(self._camera)
        px_per_ray = self._camera.jacobian(rays) / features.scale
        parts, hypotheses, which = [Matches(np.empty((0, 3)), rays[:0], px_per_ray[:0])], [], [np.empty(0, np.int64)]
        for key in self._most_alike(features):
            mine, other = self._pairs(features, key)
            part = Matches(self._keyframes[key].points[other], rays[mine], px_per_ray[mine])
            T_map_camera = resect(part)
            if T_map_camera is not None:
                hypotheses.append(T_map_camera @ inverse(T_session_camera))
            parts.append(part)
            which.append(mine)
        return Evidence(stamp_ns, T_session_camera, joined(parts), np.concatenate(which)), hypotheses

    def support(self, evidence: Sequence[Evidence], T_map_session: FloatArray) -> int:
        """Return how many features of all views are where the map says, if a hypothesis is true."""
        total = 0
        for item in evidence:
            local = transform(inverse(T_map_session @ item.T_session_camera), item.matches.points)
            off = np.linalg.norm(errors_px(item.matches, local), axis=1)
            total += len(np.unique(item.features[off < TOLERANCE_PX]))
        return total

    def _most_alike(self, features: ImageFeatures) -> list[int]:
        """Return the keyframes with the most features like those of an image, best first."""
        count = min(_NEIGHBOURS, len(self._descriptors))
        if not count or not len(features):
            return []
        distance, nearest = _nearest(features.descriptors, self._descriptors, count)
        owners = self._owner[nearest]
        votes = np.zeros(len(self._keyframes), np.int64)
        for row, near in zip(owners, distance <= _MAX_DISTANCE, strict=True):
            votes[np.unique(row[near])] += 1
        ranked = np.argsort(-votes, kind="stable")[:_KEYFRAMES]
        return [int(key) for key in ranked if votes[key] >= MIN_MATCHES]

    def _pairs(self, features: ImageFeatures, key: int) -> tuple[IntArray, IntArray]:
        """Return the features of an image and those of a keyframe that are each other's nearest."""
        theirs = self._keyframes[key].descriptors
        distance, to_theirs = _nearest(features.descriptors, theirs, 1)
        _, to_mine = _nearest(theirs, features.descriptors, 1)
        mine = np.arange(len(features))
        mutual = (to_mine[to_theirs[:, 0], 0] == mine) & (distance[:, 0] <= _MAX_DISTANCE)
        return mine[mutual], to_theirs[mutual, 0]


def _nearest(queries: ByteArray, others: ByteArray, count: int) -> tuple[IntArray, IntArray]:
    """Return Hamming distances and rows (N, count) of the nearest of ``others``, nearest first."""
    distance, index = cv2.batchDistance(queries, others, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=count)
    return np.asarray(distance, np.int64), np.asarray(index, np.int64)
