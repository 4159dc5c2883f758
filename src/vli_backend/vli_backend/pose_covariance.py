"""How well the pose of a frame is known, against the first pose of the map.

The smoother's prior carries what every keyframe that has left the window knew, so the marginal covariance of the newest
keyframe is that of the whole path behind it: zero at the first pose, which is the gauge, and growing from there. A frame after
the keyframe moves rigidly with it; its own adjustment adds what the features leave open between the two,

    P = Ad(T_frame_keyframe) P_keyframe Ad(T_frame_keyframe)ᵀ + P_frame,

for right perturbations [ω, v] (Barfoot & Furgale, 2014, to first order).

Eq. (4) takes the map as it is, so the smoother knows the pose against the map only. But the map is no truer than the poses that
it was built with: where it holds the window, the covariance of the place it was seen from is added, as that of a consider state.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, skew

_INDEPENDENT_NS = 5_000_000_000
"""Only map points of this age hold the window."""
_PLACE_M = 1e-3
"""Covariances are remembered this far apart."""


def adjoint(T: FloatArray) -> FloatArray:
    """Return Ad (6, 6) of a pose (4, 4): T Exp(ξ) T⁻¹ = Exp(Ad ξ), ξ = [ω, v]."""
    rotation = T[:3, :3]
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = rotation
    result[3:, :3] = skew(T[:3, 3]) @ rotation
    return result


def in_map_axes(covariance: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return a covariance (6, 6) of [ω, v] in the body in the order of ROS: position in map, rotation about the axes of map.

    Args:
        covariance: of a right perturbation.
        rotation: (3, 3) body to map.
    """
    turn = np.zeros((6, 6))
    turn[:3, 3:] = turn[3:, :3] = rotation
    result: FloatArray = turn @ covariance @ turn.T
    return result


class PoseCovariance:
    """Carries the covariance of the newest keyframe to the frames after it.

    Args:
        T_imu_cam: (4, 4).
        scale: factor on the variances, see ``BackEndConfig.covariance_scale``.
    """

    def __init__(self, T_imu_cam: FloatArray, scale: float) -> None:
        self._to_body = adjoint(T_imu_cam)
        self._scale = scale
        self._T_map_imu = np.eye(4)
        self._keyframe = np.zeros((6, 6))
        self._map = np.zeros((6, 6))
        self._places = _Places()

    def set_keyframe(self, stamp_ns: int, T_map_imu: FloatArray, covariance: FloatArray, on_map: bool = False) -> None:
        """Take the newest keyframe.

        Args:
            stamp_ns: of the keyframe.
            T_map_imu: (4, 4).
            covariance: (6, 6), marginal, [ω, v] in imu_link.
            on_map: True where the map holds the window.
        """
        place = self._places.seen_before(stamp_ns - _INDEPENDENT_NS, T_map_imu) if on_map else None
        self._map = place.covariance_of(T_map_imu) if place else _carried(self._map, self._T_map_imu, T_map_imu)
        self._T_map_imu, self._keyframe = T_map_imu, covariance + self._map
        if place is None:
            self._places.add(stamp_ns, _Place(T_map_imu, self._keyframe))

    def of_keyframe(self) -> FloatArray:
        """Return the covariance (6, 6) of the newest keyframe, in the order of ROS."""
        return self._scale * in_map_axes(self._keyframe, self._T_map_imu[:3, :3])

    def of_frame(self, T_map_imu: FloatArray, information: FloatArray) -> FloatArray:
        """Return the covariance (6, 6) of a later frame, in the order of ROS.

        Args:
            T_map_imu: (4, 4).
            information: (6, 6) of the frame's own adjustment, [ω, v] in the camera, keyframe and landmarks held.
        """
        own = self._to_body @ np.linalg.inv(information) @ self._to_body.T
        carried = _carried(self._keyframe, self._T_map_imu, T_map_imu)
        return self._scale * in_map_axes(carried + own, T_map_imu[:3, :3])


@dataclass(frozen=True)
class _Place:
    """A keyframe on new ground: the map around it was built from there."""

    T_map_imu: FloatArray
    covariance: FloatArray

    def covariance_of(self, T_map_imu: FloatArray) -> FloatArray:
        """Return the covariance (6, 6) of a pose that is rigidly tied to this one."""
        return _carried(self.covariance, self.T_map_imu, T_map_imu)


class _Places:
    """All places, in the order of their stamps."""

    def __init__(self) -> None:
        self._places: list[_Place] = []
        self._stamps_ns: list[int] = []
        self._positions = np.empty((64, 3))

    def add(self, stamp_ns: int, place: _Place) -> None:
        """Take a place, unless it is near the last one: nothing grows at rest."""
        count, position = len(self._places), place.T_map_imu[:3, 3]
        if count and math.dist(self._positions[count - 1], position) < _PLACE_M:
            return
        if count == len(self._positions):
            self._positions = np.concatenate([self._positions, np.empty_like(self._positions)])
        self._positions[count] = position
        self._stamps_ns.append(stamp_ns)
        self._places.append(place)

    def seen_before(self, stamp_ns: int, T_map_imu: FloatArray) -> _Place | None:
        """Return the nearest place up to a stamp: its stripes may be in the map."""
        count = bisect.bisect_right(self._stamps_ns, stamp_ns)
        if not count:
            return None
        squared = ((self._positions[:count] - T_map_imu[:3, 3]) ** 2).sum(axis=1)
        return self._places[int(squared.argmin())]


def _carried(covariance: FloatArray, T_map_before: FloatArray, T_map_after: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of the pose after, when it moves rigidly with the pose before."""
    carry = adjoint(inverse(T_map_after) @ T_map_before)
    result: FloatArray = carry @ covariance @ carry.T
    return result
