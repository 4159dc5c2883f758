"""A stripe that is gone, doubled, drowned or seen in a mirror."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from runs import map_in_truth, rmse_mm
from streams import Span, is_short, paint

from vli_common.geometry import transform
from vli_common.types import TrackingState

DISTURBED = Span(1.5, 3.5)


def test_f4_without_stripe_odometry_goes_on_and_the_map_stays_as_it_is(recording, truth, scan):
    dark = is_short(recording) & Span(1.6, 6.6).mask(recording)
    found = scan(paint(recording, dark, lambda pixels: np.full_like(pixels, 1)))
    assert found.states == [TrackingState.INITIALISING, TrackingState.TRACKING]
    assert any(reason.startswith("no laser for 5.0 s") for reason in found.reasons)
    assert found.count("empty") == dark.sum()
    seen = found.count("scans") - found.count("scans_redundant")
    assert seen - 2 <= found.count("scans_entered") <= seen
    assert rmse_mm(found.live(), truth) < 0.3
    length = [np.ptp(poses[:, :3, 3] @ poses[0, :3, :3], axis=0) for poses in (found.live().poses, _true(found, truth))]
    assert np.linalg.norm(length[0]) == pytest.approx(np.linalg.norm(length[1]), rel=0.02)


def _true(found, truth):
    return np.stack([truth(int(stamp)) for stamp in found.live().stamps_ns])


def double(pixels):
    """A mirror image of the stripe beside it, on a third of the columns, as bright as itself."""
    result = pixels.copy()
    result[:, 200:420] = np.maximum(pixels, np.roll(pixels, -25, axis=0))[:, 200:420]
    return result


def interreflection(pixels):
    """A second bounce off a wall: farther away, half as bright and blurred."""
    bounced = cv2.GaussianBlur(np.roll(pixels, 30, axis=0), (0, 0), 5.0)
    return np.maximum(pixels, np.minimum(1.5 * bounced, 255).astype(np.uint8))


def saturated(pixels):
    """Five times the laser's power: the middle of the line is white and wide."""
    return np.minimum(cv2.GaussianBlur(5.0 * pixels, (0, 0), 1.5), 255).astype(np.uint8)


@pytest.mark.parametrize("glare", [double, interreflection, saturated])
def test_f5_glare_puts_nothing_beside_the_surface_into_the_map(first_part, truth, surface, clean_first_part, scan, glare):
    found = scan(paint(first_part, is_short(first_part) & DISTURBED.mask(first_part), glare))
    assert found.states == clean_first_part.states
    assert rmse_mm(found.live(), truth) < 0.1
    off = [_off_surface(one, truth, surface) for one in (clean_first_part, found)]
    assert off[1] <= off[0] + 0.002


def _off_surface(found, truth, surface):
    """Share of the map's points that are farther than 0.3 mm, three standard deviations of a point, from what is there."""
    cloud = found.pipeline.stages.mapper.cloud()
    points = transform(map_in_truth(found.live(), truth), cloud.points.astype(np.float64))
    return float((surface.distances_mm(points) > 0.3).mean())
