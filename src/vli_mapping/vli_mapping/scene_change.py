"""Whether the scene still is what the map says: a surface through which the stripe is seen is no longer there.

Rays to the stripe also pass close by edges that the map has, the more of them the more the poses have drifted. So it does not
count how much of the whole stripe lies behind mapped points, but how much of one stretch of it does, scan after scan.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from vli_common.arrays import BoolArray, FloatArray

_SCANS = 30
"""A second of them."""
_STRETCHES = 8
"""Of a stripe, equally many points each: some five millimetres, less than a key."""
_SHARE = 0.3
"""Where a key is gone it is 0.43: rays pass between the map's points. Six passes over a keyboard that stays as it is come to
0.22 at most, with the drift of an odometry."""
_FEWEST = 0.25
"""Solid points of a stretch, as a share of those of the mean one, below which it says nothing."""


class SceneChange:
    """Watches how much of each stretch of the newest stripes lies behind what the map has in front of it."""

    def __init__(self) -> None:
        self._solid: deque[FloatArray] = deque(maxlen=_SCANS)
        self._hidden: deque[FloatArray] = deque(maxlen=_SCANS)

    def add(self, solid: BoolArray, hidden: BoolArray) -> None:
        """Take a scan: which of its points (N,), in order along the stripe, are solid, and which of these the map would hide."""
        if solid.any():
            stretch = np.arange(len(solid)) * _STRETCHES // len(solid)
            self._solid.append(np.bincount(stretch, solid, _STRETCHES).astype(np.float64))
            self._hidden.append(np.bincount(stretch, hidden, _STRETCHES).astype(np.float64))

    def clear(self) -> None:
        """Forget what was seen: another map."""
        self._solid.clear()
        self._hidden.clear()

    @property
    def share(self) -> float:
        """Largest share of the points of a stretch, in the last second, that lie behind mapped points; 0 before there is one."""
        if len(self._solid) < _SCANS:
            return 0.0
        solid, hidden = np.sum(self._solid, axis=0), np.sum(self._hidden, axis=0)
        return float((hidden / np.maximum(solid, max(_FEWEST * solid.mean(), 1.0))).max())

    @property
    def hint(self) -> str:
        """What is wrong and what to do; empty where nothing is."""
        if (share := self.share) < _SHARE:
            return ""
        return (
            f"the scene has changed: {100 * share:.0f} % of a stretch of the stripe lies behind mapped surfaces; "
            "go over it again, or ~/clear"
        )
