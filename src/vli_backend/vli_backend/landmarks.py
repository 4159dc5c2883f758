"""The landmark table: which keyframe of the window saw which feature, and where the laser measured it.

A landmark is anchored at its first observation; its bearing there is exact by definition (the track's patch was taken there).
When the anchor leaves the window, the landmark leaves with it. A track that lives on continues as a new landmark: the older
observations are marginalised with the anchor, the newest become the new landmark's, so nothing is counted twice and the
window is never starved.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from vli_backend.condense import LandmarkArrays
from vli_common.arrays import AnyArray, BoolArray, FloatArray, IntArray
from vli_common.geometry import inverse, transform

KEPT_OBSERVATIONS = 4
"""Newest slots whose observations continue as a new landmark when the anchor leaves."""
_OF_SLOTS = ("rays", "seen", "whitening", "depth", "depth_sigma")
"""Arrays with an entry for each slot; 0 where there is nothing."""
_ADOPTED_SIGMA = 0.005
"""Least relative sigma of a depth that comes from the window before."""


@dataclass(frozen=True)
class LandmarkPoints:
    """Landmarks as points for PnP: ids (N,), positions (N, 3) in map, one sigma along the anchor's ray (N, 3) in map."""

    ids: IntArray
    positions: FloatArray
    spread: FloatArray


class LandmarkTable:
    """L landmarks × K window slots, in arrays that the kernels read directly.

    Args:
        slots: most keyframes in the window at any time.
        spread: of the first guess of an inverse depth: one standard deviation, relative.
    """

    def __init__(self, slots: int, spread: float = 0.5) -> None:
        self.slots = slots
        self._spread = spread
        self.frames = 0
        self.ids: IntArray = np.empty(0, np.int64)
        self.active: BoolArray = np.empty(0, np.bool_)
        self.arrays = LandmarkArrays(
            anchor=np.empty(0, np.int64),
            anchor_ray=np.empty((0, 2)),
            rho=np.empty(0),
            prior=np.empty((0, 2)),
            rays=np.empty((0, slots, 2)),
            seen=np.empty((0, slots), np.bool_),
            whitening=np.empty((0, slots, 2, 2)),
            depth=np.empty((0, slots)),
            depth_sigma=np.empty((0, slots)),
        )
        self.stripe: FloatArray = np.empty((0, slots))
        self.information: FloatArray = np.empty(0)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def observations(self) -> IntArray:
        """Number of keyframes that saw each landmark, the anchor included (L,)."""
        counts: IntArray = np.count_nonzero(self.arrays.seen, axis=1)
        return counts

    @property
    def usable(self) -> BoolArray:
        """Landmarks seen at least twice: they say something of the poses (L,)."""
        return self.observations >= 2

    def rows_of(self, ids: IntArray) -> IntArray:
        """Return the row of the active landmark of each id, −1 where there is none."""
        lookup = {int(key): row for row, key in enumerate(self.ids) if self.active[row]}
        return np.array([lookup.get(int(key), -1) for key in ids], dtype=np.int64)

    def add_keyframe(
        self, ids: IntArray, rays: FloatArray, whitening: FloatArray, restarted: BoolArray, rho_guess: float
    ) -> None:
        """Append a keyframe: known ids get an observation, new ones (and restarted tracks) a landmark anchored here.

        Args:
            ids: (N,).
            rays: (N, 2).
            whitening: (N, 2, 2) of the rays, see :mod:`vli_backend.track_noise`.
            restarted: (N,) True where the track's patch was taken anew since the last keyframe.
            rho_guess: first inverse depth of new landmarks, 1/m.
        """
        slot = self.frames
        self.frames += 1
        rows = self.rows_of(ids)
        self.active[rows[(rows >= 0) & restarted]] = False
        known = (rows >= 0) & ~restarted
        self._observe(rows[known], slot, rays[known], whitening[known])
        self._append(ids[~known], slot, rays[~known], whitening[~known], np.full(np.count_nonzero(~known), rho_guess))

    def adopt(self, landmarks: LandmarkPoints, T_map_camera: FloatArray, near_m: float) -> None:
        """Take what a window that has just ended knew of the depths; only while this table has a single keyframe.

        The prior on each depth is as wide as the old window left it, not narrower than its poses are known.

        Args:
            landmarks: of the old window.
            T_map_camera: (4, 4) of the keyframe.
            near_m: least depth.
        """
        rows = self.rows_of(landmarks.ids)
        points = transform(inverse(T_map_camera), landmarks.positions)
        usable = (rows >= 0) & (points[:, 2] > near_m)
        rows, depth = rows[usable], points[usable, 2]
        relative = np.linalg.norm(landmarks.spread[usable], axis=1) / np.linalg.norm(points[usable], axis=1)
        self.arrays.rho[rows] = 1.0 / depth
        self.arrays.prior[rows, 0], self.arrays.prior[rows, 1] = 1.0 / depth, np.maximum(relative, _ADOPTED_SIGMA) / depth
        self.information[rows] = 0.0

    def widen(self, spread: float) -> None:
        """Let the guesses so far say less: one standard deviation, relative. What was adopted is no guess."""
        prior = self.arrays.prior
        is_guess = prior[:, 1] > 0.9 * self._spread * prior[:, 0]
        prior[is_guess, 1] = np.maximum(prior[is_guess, 1], spread * prior[is_guess, 0])

    def set_depths(
        self, slot: int, rows: IntArray, inverse_depth: FloatArray, sigma: FloatArray, stripe_px: FloatArray, primary_only: bool
    ) -> None:
        """Store laser depths, eq. (2), of landmarks seen in ``slot``.

        With ``primary_only`` a landmark keeps one depth: of its primary frame, in which it was nearest to the stripe.
        """
        if primary_only:
            others = self.stripe[rows].copy()
            others[:, slot] = np.inf
            better = stripe_px <= others.min(axis=1)
            self.arrays.depth_sigma[rows[~better], slot] = 0.0
            self.stripe[rows[~better], slot] = np.inf
            rows, inverse_depth, sigma, stripe_px = rows[better], inverse_depth[better], sigma[better], stripe_px[better]
            self.arrays.depth_sigma[rows] = 0.0
            self.stripe[rows] = np.inf
        self.arrays.depth[rows, slot] = inverse_depth
        self.arrays.depth_sigma[rows, slot] = sigma
        self.stripe[rows, slot] = stripe_px

    def split(self) -> BoolArray:
        """Prepare the oldest keyframe's departure; return the mask (L,) of landmarks that leave with it.

        A leaving landmark whose track is still followed hands its newest observations to a new landmark.
        """
        arrays = self.arrays
        leaving = arrays.anchor == 0
        first_kept = max(1, self.frames - KEPT_OBSERVATIONS)
        kept = arrays.seen[:, first_kept : self.frames]
        continues = leaving & self.active & kept[:, -1] & (np.count_nonzero(kept, axis=1) >= 2)
        rows = np.flatnonzero(continues)
        anchors = first_kept + np.argmax(kept[rows], axis=1)
        old = len(self)
        rho = arrays.rho[rows]
        self._append(self.ids[rows], anchors, arrays.rays[rows, anchors], arrays.whitening[rows, anchors], rho)
        self.active[rows] = False
        window = slice(first_kept, self.slots)
        for name in _OF_SLOTS:
            table = getattr(self.arrays, name)
            table[old:, window] = table[rows, window]
        self.stripe[old:, window] = self.stripe[rows, window]
        self.information[old:] = self.information[rows]
        self.arrays.seen[rows, window] = False
        self.arrays.depth_sigma[rows, window] = 0.0
        return np.concatenate([leaving, np.zeros(len(rows), np.bool_)])

    def drop_oldest(self, leaving: BoolArray) -> None:
        """Remove the landmarks that leave, and slot 0; all others move one slot down."""
        self._keep(~leaving)
        arrays = self.arrays
        arrays.anchor -= 1
        for name in _OF_SLOTS:
            table = getattr(arrays, name)
            table[:, :-1] = table[:, 1:].copy()
            table[:, -1] = 0
        self.stripe[:, :-1] = self.stripe[:, 1:].copy()
        self.stripe[:, -1] = np.inf
        self.frames -= 1

    def points(self, poses: FloatArray) -> LandmarkPoints:
        """Return the landmarks whose tracks go on as points in map, keyframe poses ``T_map_camera`` (K, 4, 4) given."""
        return self._points(np.flatnonzero(self.active), poses)

    def all_points(self, poses: FloatArray) -> LandmarkPoints:
        """Like :meth:`points`, of all landmarks that were seen twice, those whose tracks have ended too."""
        return self._points(np.flatnonzero(self.usable), poses)

    def _points(self, rows: IntArray, poses: FloatArray) -> LandmarkPoints:
        arrays = self.arrays
        anchors, rho = poses[arrays.anchor[rows]], arrays.rho[rows]
        rays = np.concatenate([arrays.anchor_ray[rows], np.ones((len(rows), 1))], axis=1)
        directions = np.einsum("nij,nj->ni", anchors[:, :3, :3], rays) / rho[:, None]
        information = np.maximum(self.information[rows], arrays.prior[rows, 1] ** -2)
        spread = directions * (information**-0.5 / rho)[:, None]
        return LandmarkPoints(self.ids[rows], directions + anchors[:, :3, 3], spread)

    def forget_lost(self, ids: IntArray) -> None:
        """Deactivate landmarks whose track has ended; those seen only once are removed."""
        lost = self.active & ~np.isin(self.ids, ids)
        self.active[lost] = False
        self._keep(self.active | (self.observations >= 2))

    def _append(self, ids: IntArray, anchors: AnyArray | int, rays: FloatArray, whitening: FloatArray, rho: FloatArray) -> None:
        count, old = len(ids), len(self)
        arrays = self.arrays
        self.ids = np.concatenate([self.ids, ids])
        self.active = np.concatenate([self.active, np.ones(count, np.bool_)])
        arrays.anchor = np.concatenate([arrays.anchor, np.broadcast_to(np.asarray(anchors, np.int64), count)])
        arrays.anchor_ray = np.concatenate([arrays.anchor_ray, rays])
        arrays.rho = np.concatenate([arrays.rho, rho])
        arrays.prior = np.concatenate([arrays.prior, np.stack([rho, self._spread * rho], axis=1)])
        for name in _OF_SLOTS:
            table = getattr(arrays, name)
            setattr(arrays, name, np.concatenate([table, np.zeros((count, *table.shape[1:]), table.dtype)]))
        self.stripe = np.concatenate([self.stripe, np.full((count, self.slots), np.inf)])
        self.information = np.concatenate([self.information, np.full(count, 0.0)])
        self._observe(np.arange(old, old + count), anchors, rays, whitening)

    def _observe(self, rows: IntArray, slots: AnyArray | int, rays: FloatArray, whitening: FloatArray) -> None:
        self.arrays.rays[rows, slots] = rays
        self.arrays.seen[rows, slots] = True
        self.arrays.whitening[rows, slots] = whitening

    def _keep(self, mask: BoolArray) -> None:
        arrays = self.arrays
        self.ids, self.active, self.stripe, self.information = (
            self.ids[mask],
            self.active[mask],
            self.stripe[mask],
            self.information[mask],
        )
        for field in fields(arrays):
            setattr(arrays, field.name, np.ascontiguousarray(getattr(arrays, field.name)[mask]))
