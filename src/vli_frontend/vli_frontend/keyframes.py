"""When a long frame becomes a keyframe, and whether the scanner is at rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vli_common.arrays import FloatArray, IntArray
from vli_frontend.config import KeyframeConfig
from vli_frontend.synchroniser import seconds_to_ns

_REFERENCE_FOCAL_PX = 460.0
_COMMON_SHARE = 0.6
"""Share of the keyframe's own tracks below which a new one is due where it had few: a poor scene is no reason for one a frame."""


@dataclass(frozen=True, slots=True)
class FrameVerdict:
    """What one long frame is; ``reason`` says why it is a keyframe, or is empty."""

    keyframe: bool
    stationary: bool
    reason: str


@dataclass(frozen=True, slots=True)
class _Keyframe:
    stamp_ns: int
    stationary: bool
    ids: IntArray
    rays: FloatArray


class KeyframeRule:
    """Enough parallax since the last keyframe, too few tracks left, or time.

    Parallax is the mean motion of the tracks in common, with the rotation taken out.

    Args:
        config: thresholds.
        focal_px: of the camera.
        uses_laser: whether the laser gives the scale.
    """

    def __init__(self, config: KeyframeConfig, focal_px: float, uses_laser: bool = True) -> None:
        self._config = config
        self._parallax = (config.parallax_px if uses_laser else config.parallax_vi_px) / _REFERENCE_FOCAL_PX
        self._rest_flow = config.rest_flow_px / focal_px
        self._motion_ns, self._rest_ns = seconds_to_ns(config.motion_s), seconds_to_ns(config.rest_s)
        self._last: _Keyframe | None = None

    def reset(self) -> None:
        """Forget the last keyframe: the next frame is one."""
        self._last = None

    def judge(
        self, stamp_ns: int, ids: IntArray, rays: FloatArray, rotation: FloatArray | None, mean_rate: FloatArray | None
    ) -> FrameVerdict:
        """Judge one frame.

        Args:
            stamp_ns: of the frame.
            ids: (N,) of its tracks, ascending.
            rays: (N, 2).
            rotation: (3, 3) that turns directions of the last keyframe's camera into this one, or None where unknown.
            mean_rate: (3,) angular rate since the frame before, rad/s, bias taken out, or None where unknown.
        """
        quiet = mean_rate is None or float(np.linalg.norm(mean_rate)) < self._config.rest_gyro
        last = self._last
        if last is None:
            # One frame shows no motion: the gyroscope decides alone.
            return FrameVerdict(True, mean_rate is not None and quiet, "first")
        _, before, now = np.intersect1d(last.ids, ids, assume_unique=True, return_indices=True)
        moved = np.hypot(*(rays[now] - last.rays[before]).T)
        stationary = quiet and len(moved) > 0 and float(np.median(moved)) < self._rest_flow
        turned = last.rays[before] if rotation is None else _turn(last.rays[before], rotation)
        parallax = float(np.hypot(*(rays[now] - turned).T).mean()) if len(now) else 0.0
        reason = self._reason(last, stamp_ns, len(now), parallax, stationary)
        return FrameVerdict(bool(reason), stationary, reason)

    def accept(self, stamp_ns: int, stationary: bool, ids: IntArray, rays: FloatArray) -> None:
        """Take a frame, with its new tracks (N,), (N, 2), as the last keyframe."""
        self._last = _Keyframe(stamp_ns, stationary, ids, rays)

    def _reason(self, last: _Keyframe, stamp_ns: int, common: int, parallax: float, stationary: bool) -> str:
        if parallax >= self._parallax:
            return "parallax"
        if common < min(self._config.min_tracks, _COMMON_SHARE * len(last.ids)):
            return "few tracks"
        longest_ns = self._rest_ns if stationary and last.stationary else self._motion_ns
        return "time" if stamp_ns - last.stamp_ns >= longest_ns else ""


def _turn(rays: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return rays (N, 2) after a rotation of the camera."""
    points = rays @ rotation[:, :2].T + rotation[:, 2]
    result: FloatArray = points[:, :2] / points[:, 2:]
    return result
