"""Whether the tracks are lost because the scanner moves too fast, in words for who holds it."""

from __future__ import annotations

from collections import deque

import numpy as np

_FRAMES = 10
"""A third of a second: a twitch is over by then."""
_LOST_SHARE = 0.3
"""Of the tracks, in one frame. A tenth leaves the image where it moves as it should."""
_FAST_PX = 12.0
"""Image motion of a frame from which on it may be why: half the width of the window that is followed."""


class MotionHint:
    """Watches how fast the image moves, and how many tracks survive that."""

    def __init__(self) -> None:
        self._frames: deque[tuple[float, float]] = deque(maxlen=_FRAMES)

    def reset(self) -> None:
        """Forget what was seen."""
        self._frames.clear()

    def add(self, before: int, after: int, motion_px: float) -> None:
        """Take a frame.

        Args:
            before, after: tracks in the frame before, and of those in this one.
            motion_px: median motion between the two.
        """
        self._frames.append((1.0 - after / before if before else 1.0, motion_px))

    @property
    def text(self) -> str:
        """What is wrong and what to do; empty where nothing is."""
        if len(self._frames) < _FRAMES:
            return ""
        lost, motion_px = np.median(np.array(self._frames), axis=0)
        if lost < _LOST_SHARE or motion_px < _FAST_PX:
            return ""
        return f"move slower: the image moves {motion_px:.0f} px a frame, and {100 * lost:.0f} % of the features are lost"
