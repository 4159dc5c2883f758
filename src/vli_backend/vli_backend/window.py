"""Frames between keyframes: where each stripe was, given the keyframes around it.

Eq. (4) interpolates the pose of a stripe between the adjacent keyframes. Under hand tremor that alone misplaces it by some
0.1 mm, more than the laser's noise. So the measured shape of the motion is folded in: every long frame has a pose of its own, and
a short one that of a cubic through the long ones around it. A frame's deviation from the interpolation,
δ = interp(T_k, T_k+1, α)⁻¹ T, is taken once when the interval closes, and kept while the keyframes move.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vli_backend.path_interpolation import interpolate_path
from vli_common.arrays import AnyArray, BoolArray, ByteArray, FloatArray, IntArray
from vli_common.geometry import interpolate, inverse
from vli_common.types import FrameKind, LaserScan, WindowPoses


@dataclass(frozen=True)
class Interval:
    """Long and short frames strictly between two adjacent keyframes.

    Args:
        stamps: (M,) int64, ascending.
        kinds: (M,) :class:`FrameKind` codes.
        redundant: (M,) bool, taken at rest.
        alpha: (M,) position between the keyframes, 0 to 1.
        delta: (M, 4, 4) deviation from the interpolated pose.
        scans: by stamp, those of the short frames.
    """

    stamps: IntArray
    kinds: ByteArray
    redundant: BoolArray
    alpha: FloatArray
    delta: FloatArray
    scans: dict[int, LaserScan] = field(default_factory=dict)

    def poses(self, T_start: FloatArray, T_end: FloatArray) -> FloatArray:
        """Return ``T_map_camera`` (M, 4, 4) of the frames, given those of the two keyframes."""
        if not len(self.stamps):
            return np.empty((0, 4, 4))
        return interpolate(T_start, T_end, self.alpha) @ self.delta


@dataclass(frozen=True)
class FrameRecord:
    """A long frame since the last keyframe: stamp, ``T_map_camera`` (4, 4), at rest or not."""

    stamp_ns: int
    T_map_camera: FloatArray
    stationary: bool


def close_interval(frames: list[FrameRecord], scans: list[LaserScan], longest_ns: int | None = None) -> Interval:
    """Return the interval between ``frames[0]`` and ``frames[-1]`` (the keyframes), with the scans taken in it.

    Short frames get the pose that the long frames around them tell; where these are farther apart than ``longest_ns``, and not at
    rest, they are left out.
    """
    start, end = frames[0], frames[-1]
    inner = frames[1:-1]
    stamps = np.array([f.stamp_ns for f in frames], dtype=np.int64)
    rest = np.array([f.stationary for f in frames], np.bool_)
    scans, before = _between(stamps, rest, scans, longest_ns)
    scan_stamps = np.array([s.stamp_ns for s in scans], dtype=np.int64)
    poses = np.stack([f.T_map_camera for f in frames])
    scan_poses = interpolate_path(stamps, poses, scan_stamps)

    all_stamps = np.concatenate([stamps[1:-1], scan_stamps])
    order = np.argsort(all_stamps, kind="stable")
    all_poses = np.concatenate([poses[1:-1], scan_poses])[order]
    alpha = (all_stamps[order] - start.stamp_ns) / (end.stamp_ns - start.stamp_ns)
    kinds = np.concatenate([np.full(len(inner), FrameKind.LONG.value), np.full(len(scans), FrameKind.SHORT.value)])
    redundant = np.concatenate([rest[1:-1], rest[before] & rest[before + 1]])
    interpolated = interpolate(start.T_map_camera, end.T_map_camera, alpha) if len(alpha) else np.empty((0, 4, 4))
    return Interval(
        all_stamps[order],
        kinds[order].astype(np.uint8),
        redundant[order],
        alpha,
        inverse(interpolated) @ all_poses,
        {scan.stamp_ns: scan for scan in scans},
    )


def _between(
    stamps: IntArray, rest: BoolArray, scans: list[LaserScan], longest_ns: int | None
) -> tuple[list[LaserScan], IntArray]:
    """Return the scans taken between long frames (K,), at rest or near enough, and the index (M,) of the one before each."""
    taken = np.array([scan.stamp_ns for scan in scans], dtype=np.int64)
    before = np.clip(np.searchsorted(stamps, taken, side="right") - 1, 0, len(stamps) - 2)
    told = (taken > stamps[0]) & (taken < stamps[-1])
    if longest_ns is not None:
        told &= (stamps[before + 1] - stamps[before] <= longest_ns) | (rest[before] & rest[before + 1])
    return [scan for scan, is_told in zip(scans, told, strict=True) if is_told], before[told]


class Window:
    """Keyframe stamps and the intervals between them; poses are handed in by the caller, who has them from the smoother."""

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.stationary: list[bool] = []
        self.intervals: list[Interval] = []

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def newest_scan(self) -> LaserScan | None:
        """The last stripe of the newest interval that has any."""
        return next((list(interval.scans.values())[-1] for interval in reversed(self.intervals) if interval.scans), None)

    def append(self, stamp_ns: int, stationary: bool, interval: Interval | None) -> None:
        """Add a keyframe and the interval before it (None for the first)."""
        if interval is not None:
            self.intervals.append(interval)
        self.stamps.append(stamp_ns)
        self.stationary.append(stationary)

    def drop_oldest(self) -> None:
        """Forget the oldest keyframe and the interval after it."""
        del self.stamps[0], self.stationary[0], self.intervals[0]

    def near_scans(self, slot: int, T_map_camera: FloatArray, within_ns: int) -> list[tuple[FloatArray, LaserScan]]:
        """Return (pose (4, 4), scan) of the scans within ``within_ns`` of a keyframe, keyframe poses (K, 4, 4) given."""
        centre = self.stamps[slot]
        found: list[tuple[FloatArray, LaserScan]] = []
        for k in range(max(0, slot - 2), min(len(self.intervals), slot + 2)):
            interval = self.intervals[k]
            short = (interval.kinds == FrameKind.SHORT.value) & (np.abs(interval.stamps - centre) <= within_ns)
            if short.any():
                poses = interval.poses(T_map_camera[k], T_map_camera[k + 1])[short]
                found += [(pose, interval.scans[int(stamp)]) for pose, stamp in zip(poses, interval.stamps[short], strict=True)]
        return found

    def poses(self, T_map_camera: FloatArray, leaving: int, session: int) -> WindowPoses:
        """Return all frames of the window; the first ``leaving`` keyframes and the intervals after them are final.

        Args:
            T_map_camera: (K, 4, 4) of the keyframes.
            leaving: how many keyframes leave the window.
            session: of the message.
        """
        starts = np.repeat(np.arange(len(self.intervals)), [len(interval.stamps) for interval in self.intervals])
        inner = interpolate(T_map_camera[starts], T_map_camera[starts + 1], self._joined("alpha")) @ self._joined("delta")
        keyframes = np.full(len(self), FrameKind.KEYFRAME.value, np.uint8)
        stamps = np.concatenate([np.array(self.stamps, np.int64), self._joined("stamps")])
        order = np.argsort(stamps, kind="stable")
        return WindowPoses(
            self.stamps[-1],
            stamps[order],
            np.concatenate([keyframes, self._joined("kinds")])[order],
            np.concatenate([np.arange(len(self)) < leaving, starts < leaving])[order],
            np.concatenate([np.array(self.stationary, np.bool_), self._joined("redundant")])[order],
            np.concatenate([T_map_camera, inner])[order],
            session,
        )

    def _joined(self, name: str) -> AnyArray:
        """Return one column of all intervals, end to end; of the right shape also when there are none."""
        empty = Interval(np.empty(0, np.int64), np.empty(0, np.uint8), np.empty(0, np.bool_), np.empty(0), np.empty((0, 4, 4)))
        return np.concatenate([getattr(interval, name) for interval in (empty, *self.intervals)])
