"""The stamps of one stream: rate, gaps, order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from vli_bringup.diagnosis.findings import Finding, Level
from vli_common.types import NANOSECONDS

_RATE_TOLERANCE = 0.05
_FEW_MISSING = 2e-3
_JITTER = 0.2


def check_stamps(subject: str, stamps: Sequence[int], expected_hz: float | None, period_key: str) -> Iterator[Finding]:
    """Judge the stamps of a stream, in the order in which they came.

    Args:
        subject: of the findings.
        stamps: ns.
        expected_hz: what the calibration says; None where it says nothing.
        period_key: of the calibration that holds it.
    """
    if len(stamps) < 2:
        yield Finding(Level.PROBLEM, subject, f"{len(stamps)} messages came; check the sensor's driver and the topic's name")
        return
    times = np.asarray(stamps, dtype=np.int64)
    if not times.any():
        yield Finding(Level.PROBLEM, subject, "every stamp is 0; header.stamp must be the time of measurement")
        return
    steps = np.diff(times)
    backwards = int((steps <= 0).sum())
    if backwards:
        text = f"{backwards} of {len(steps)} stamps do not increase; frames out of order or doubled are dropped"
        yield Finding(Level.WARNING, subject, text)
    yield from _check_rate(subject, steps[steps > 0], expected_hz, period_key)


def _check_rate(subject: str, steps: np.ndarray, expected_hz: float | None, period_key: str) -> Iterator[Finding]:
    if not len(steps):
        return
    period = float(np.median(steps))
    rate = NANOSECONDS / period
    if expected_hz is not None and abs(rate - expected_hz) > _RATE_TOLERANCE * expected_hz:
        text = f"{rate:.1f} a second, the calibration says {expected_hz:g}; correct '{period_key}' or the driver's rate"
        yield Finding(Level.WARNING, subject, text)
    else:
        yield Finding(Level.GOOD, subject, f"{len(steps) + 1} messages, {rate:.1f} a second")
    missing = int(np.maximum(np.rint(steps / period) - 1, 0).sum())
    share = missing / (missing + len(steps) + 1)
    if share > _FEW_MISSING:
        longest_s = steps.max() / NANOSECONDS
        text = f"{missing} messages missing ({100 * share:.1f} %), longest gap {longest_s:.3f} s; disk, cable or CPU too slow?"
        yield Finding(Level.WARNING, subject, text)
    regular = steps[steps < 1.5 * period]
    jitter = float(np.median(np.abs(regular - period))) / period
    if jitter > _JITTER:
        text = f"stamps jitter by {100 * jitter:.0f} % of the period; stamp by the trigger, not on arrival"
        yield Finding(Level.WARNING, subject, text)
