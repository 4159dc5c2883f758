"""Feature tracks through the long frames: predict, follow, align to the patch seen at birth, reject outliers, replenish."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from vli_common.arrays import BoolArray, ByteArray, FloatArray, IntArray
from vli_common.camera import CameraModel
from vli_common.types import Counters, TrackFlag
from vli_frontend.config import FrontEndConfig
from vli_frontend.detection import detect
from vli_frontend.klt import follow
from vli_frontend.outliers import OutlierRejection
from vli_frontend.patch_alignment import MARGIN_PX, PatchTemplates
from vli_frontend.photometry import Frame

_MAX_SIGMA_PX = 2.0
"""A position that is worse is of no use, whatever its own estimate: keeps infinities out of the messages."""


@dataclass(slots=True)
class TrackTable:
    """What is known of each track, as columns of one length N.

    Args:
        ids: (N,) int64.
        pixels: (N, 2), raw, in the newest frame.
        rays: (N, 2), undistorted normalised.
        velocity: (N, 2), of the rays, 1/s.
        flow: (N, 2), pixels a second beyond what the rotation explains.
        age: (N,) frames since the template was taken.
        slots: (N,) of the template.
        affine: (N, 2, 2), patch at birth → newest frame.
        sigma: (N,) pixels per axis, of the newest position against the patch at birth.
        flags: (N,) uint8, of the newest frame.
    """

    ids: IntArray
    pixels: FloatArray
    rays: FloatArray
    velocity: FloatArray
    flow: FloatArray
    age: IntArray
    slots: IntArray
    affine: FloatArray
    sigma: FloatArray
    flags: ByteArray

    def __len__(self) -> int:
        return len(self.ids)

    @staticmethod
    def new(
        ids: IntArray, pixels: FloatArray, rays: FloatArray, slots: IntArray, flow: FloatArray, sigma: FloatArray
    ) -> TrackTable:
        """Return tracks seen for the first time; ``flow`` (2,) is the guess for all."""
        n = len(ids)
        affine = np.tile(np.eye(2), (n, 1, 1))
        flags = np.full(n, int(TrackFlag.NEW), np.uint8)
        age = np.zeros(n, np.int64)
        return TrackTable(ids, pixels, rays, np.zeros((n, 2)), np.tile(flow, (n, 1)), age, slots, affine, sigma, flags)

    def keep(self, mask: BoolArray) -> None:
        """Drop the tracks where ``mask`` (N,) is False."""
        for column in fields(self):
            setattr(self, column.name, getattr(self, column.name)[mask])

    def extend(self, other: TrackTable) -> None:
        """Append tracks."""
        for column in fields(self):
            setattr(self, column.name, np.concatenate([getattr(self, column.name), getattr(other, column.name)]))


class Tracker:
    """Tracks of one session.

    Args:
        camera: of the calibration.
        config: see :class:`FrontEndConfig`.
        counters: of the stage.
        first_id: of a session's tracks.
        blind_s: after so long without an image no small motion vouches for a track: what does not look like its patch is another
            point.
    """

    def __init__(
        self, camera: CameraModel, config: FrontEndConfig, counters: Counters, first_id: int = 1, blind_s: float = np.inf
    ) -> None:
        self._blind_s = blind_s
        self._first_id = first_id
        self._camera, self._config, self._counters = camera, config, counters
        self._templates = PatchTemplates(config.max_features)
        self._outliers = OutlierRejection(camera, config.klt.outlier_px)
        self.reset()

    def reset(self) -> None:
        """Forget all tracks; ids start anew."""
        none, nowhere = np.empty(0, np.int64), np.empty((0, 2))
        self.tracks = TrackTable.new(none, nowhere, nowhere, none, np.zeros(2), np.empty(0))
        self._previous: Frame | None = None
        self._next_id = self._first_id
        self._outliers.reset()

    @property
    def sigma_px(self) -> FloatArray:
        """Standard deviation (N,) of each position per axis: that of the alignment, growing with the age of the patch."""
        config, tracks = self._config, self.tracks
        measured = np.clip(tracks.sigma, config.sigma_px, _MAX_SIGMA_PX)
        result: FloatArray = np.hypot(measured, config.sigma_growth_px * tracks.age)
        return result

    def follow(self, frame: Frame, dt_s: float, rotation: FloatArray | None) -> None:
        """Find the tracks in the next frame and drop those that are lost or do not fit.

        Args:
            frame: the newest.
            dt_s: since the one before.
            rotation: (3, 3) that turns directions of the camera before into the camera now, or None where unknown.
        """
        if self._previous is not None and len(self.tracks):
            self._advance(self._previous, frame, dt_s, rotation)
        self._previous = frame

    def replenish(self, frame: Frame) -> None:
        """Detect new points where there are few, up to the greatest number."""
        tracks = self.tracks
        pixels = detect(frame.half, tracks.pixels, self._config.max_features - len(tracks), self._config.detection)
        count = len(pixels)
        slots = np.setdiff1d(np.arange(self._config.max_features), tracks.slots)[:count]
        ids = np.arange(self._next_id, self._next_id + count)
        self._next_id += count
        self._templates.create(frame.grey, slots, pixels)
        flow = np.median(tracks.flow, axis=0) if len(tracks) else np.zeros(2)
        sigma = self._templates.initial_sigma(slots)
        tracks.extend(TrackTable.new(ids, pixels, self._camera.unproject(pixels), slots, flow, sigma))
        self._counters.add("tracks_started", count)

    def _advance(self, previous: Frame, frame: Frame, dt_s: float, rotation: FloatArray | None) -> None:
        tracks = self.tracks
        turned = tracks.pixels if rotation is None else self._turn(tracks.rays, tracks.pixels, rotation)
        found, ok = follow(previous, frame, tracks.pixels, turned + tracks.flow * dt_s, self._config.klt)
        ok &= self._inside(found)
        self._counters.add("tracks_lost", int((~ok).sum()))
        tracks.keep(ok)
        tracks.pixels, tracks.age, tracks.flags = found[ok], tracks.age + 1, np.zeros(len(tracks), np.uint8)
        if self._config.klt.alignment:
            self._align(frame.grey)
        tracks.flow = (tracks.pixels - turned[ok]) / dt_s
        if dt_s > self._blind_s:
            self._keep_proven()
        self._reject(dt_s, rotation)

    def _keep_proven(self) -> None:
        """Drop the tracks whose patch has just been taken anew: what they follow now may be what they followed before, or not."""
        proven = (self.tracks.flags & TrackFlag.TEMPLATE) == 0
        self._counters.add("tracks_lost", int((~proven).sum()))
        self.tracks.keep(proven)

    def _turn(self, rays: FloatArray, pixels: FloatArray, rotation: FloatArray) -> FloatArray:
        """Return pixels (N, 2) after a rotation of the camera; where a ray leaves the front, as they were."""
        points = np.column_stack([rays, np.ones(len(rays))]) @ rotation.T
        turned = self._camera.project(points)
        result: FloatArray = np.where(np.isfinite(turned), turned, pixels)
        return result

    def _inside(self, pixels: FloatArray) -> BoolArray:
        """Return (N,) True where a whole patch fits into the image."""
        limit = [self._camera.width - 1 - MARGIN_PX, self._camera.height - 1 - MARGIN_PX]
        result: BoolArray = np.all((pixels >= MARGIN_PX) & (pixels <= limit), axis=1)
        return result

    def _align(self, grey: ByteArray) -> None:
        """Move the tracks to where their first patch fits best; take a new patch where it does not."""
        tracks, klt = self.tracks, self._config.klt
        aligned = self._templates.align(grey, tracks.slots, tracks.pixels, tracks.affine)
        moved = np.hypot(*(aligned.pixels - tracks.pixels).T)
        good = aligned.converged & (aligned.correlation >= klt.min_correlation) & (moved <= klt.max_correction_px)
        good &= self._inside(aligned.pixels)
        tracks.pixels = np.where(good[:, None], aligned.pixels, tracks.pixels)
        tracks.affine = np.where(good[:, None, None], aligned.affine, np.eye(2))
        tracks.age[~good] = 0
        tracks.flags[~good] |= int(TrackFlag.TEMPLATE)
        self._templates.create(grey, tracks.slots[~good], tracks.pixels[~good])
        tracks.sigma = np.where(good, aligned.sigma, self._templates.initial_sigma(tracks.slots))
        self._counters.add("templates_renewed", int((~good).sum()))

    def _reject(self, dt_s: float, rotation: FloatArray | None) -> None:
        tracks = self.tracks
        rays = self._camera.unproject(tracks.pixels)
        inliers = self._outliers.inliers(tracks.rays, rays, rotation)
        tracks.velocity, tracks.rays = (rays - tracks.rays) / dt_s, rays
        self._counters.add("tracks_rejected", int((~inliers).sum()))
        tracks.keep(inliers)
