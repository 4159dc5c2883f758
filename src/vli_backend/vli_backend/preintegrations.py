"""GTSAM's object out of a :class:`vli_common.types.Preintegration`, which the other stages carry without knowing it."""

from __future__ import annotations

import gtsam

from vli_common.types import Preintegration


def measurements_of(preintegration: Preintegration | None) -> gtsam.PreintegratedCombinedMeasurements:
    """Return the measurements of a frame that must have them.

    Raises:
        TypeError: there are none, which the caller should have seen to.
    """
    if preintegration is None or not isinstance(preintegration.measurements, gtsam.PreintegratedCombinedMeasurements):
        raise TypeError("frames between keyframes need their preintegration here")
    return preintegration.measurements
