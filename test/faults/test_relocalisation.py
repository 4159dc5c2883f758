"""F18: lifted off, and put down elsewhere on the mapped part."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from runs import map_in_truth
from streams import Span, after, images, is_image, paint

from vli_common.geometry import transform
from vli_common.types import TrackingState

LIFTED_S, AWAY_S = 7.0, 1.5
"""The demo scan, then a dark second and a half in which the IMU feels the scan go on, then somewhere else."""


@pytest.mark.slow
@pytest.mark.parametrize("begin_s", [2.0, 3.5])
def test_f18_put_down_elsewhere_the_place_in_the_map_is_found_within_two_seconds(recording, truth, scan, begin_s):
    first = recording
    away = paint(dark := _from(recording, 4.0, 4.0 + AWAY_S), is_image(dark), lambda pixels: np.full_like(pixels, 1))
    again = _from(recording, begin_s, 7.0)
    whole = after(after(first, away), again)
    found = scan(whole)
    stamps = [image.stamp_ns for image in images(whole)]
    shift_ns = stamps[len(images(first)) + len(images(away))] - images(again)[0].stamp_ns
    T_truth_map = map_in_truth(found.live(1.0, LIFTED_S - 0.2), truth)
    assert TrackingState.LOST in found.states
    begin = (images(again)[0].stamp_ns + shift_ns - stamps[0]) * 1e-9
    back = next(output for output in found.within(begin) if output.pose is not None)
    located = [window for window in found.windows if window.placement == 2]
    assert located, "not relocalised"
    assert (located[0].stamp_ns - back.stamp_ns) * 1e-9 < 2.0
    live = found.live((located[0].stamp_ns - stamps[0]) * 1e-9 + 0.05)
    true = np.stack([truth(int(stamp) - shift_ns) for stamp in live.stamps_ns])
    off = np.linalg.norm(transform(T_truth_map, live.positions) - true[:, :3, 3], axis=1)
    assert off.max() < 5e-4
    assert all(later.placement >= earlier.placement for earlier, later in pairwise(found.windows))


def _from(stream, begin_s, end_s):
    """Return a stretch of a recording."""
    return [item for item, inside in zip(stream, Span(begin_s, end_s).mask(stream), strict=True) if inside]
