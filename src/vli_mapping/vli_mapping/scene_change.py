"""Whether the scene still is what the map says: a surface through which the stripe is seen is no longer there."""

from __future__ import annotations

from collections import deque

_SCANS = 30
"""A second of them."""
_SHARE = 0.05
"""Of the stripe behind mapped surfaces. In scenes that stay as they are it was at most 0.02 in any second."""


class SceneChange:
    """Watches how much of the newest stripes lies behind what the map has in front of them."""

    def __init__(self) -> None:
        self._shares: deque[float] = deque(maxlen=_SCANS)

    def add(self, solid: int, hidden: int) -> None:
        """Take a scan: its solid points, and those that the map would hide."""
        if solid:
            self._shares.append(hidden / solid)

    def clear(self) -> None:
        """Forget what was seen: another map."""
        self._shares.clear()

    @property
    def hint(self) -> str:
        """What is wrong and what to do; empty where nothing is."""
        if len(self._shares) < _SCANS or (share := sum(self._shares) / _SCANS) < _SHARE:
            return ""
        return (
            f"the scene has changed: {100 * share:.0f} % of the stripe lies behind mapped surfaces; go over it again, or ~/clear"
        )
