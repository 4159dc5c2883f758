"""When a frame becomes a keyframe, and when the scanner is at rest."""

from __future__ import annotations

import numpy as np
import pytest

from vli_common.geometry import so3_exp
from vli_frontend.config import KeyframeConfig
from vli_frontend.keyframes import FrameVerdict, KeyframeRule

F = 460.0
MS = 1_000_000
IDS = np.arange(1, 101)
RAYS = np.random.default_rng(0).uniform(-0.5, 0.5, (100, 2))
QUIET, BUSY = np.full(3, 0.001), np.full(3, 0.3)


@pytest.fixture
def rule() -> KeyframeRule:
    rule = KeyframeRule(KeyframeConfig(parallax_px=30.0), F)
    rule.accept(0, False, IDS, RAYS)
    return rule


def judge(rule: KeyframeRule, ms: int, shift_px: float = 0.0, tracks: int = 100, quiet: bool = False) -> FrameVerdict:
    moved = RAYS[:tracks] + np.array([shift_px / F, 0.0])
    return rule.judge(ms * MS, IDS[:tracks], moved, np.eye(3), QUIET if quiet else BUSY)


def test_the_first_frame_is_a_keyframe_and_the_gyroscope_tells_whether_at_rest() -> None:
    rule = KeyframeRule(KeyframeConfig(), F)
    assert rule.judge(0, IDS, RAYS, None, BUSY) == FrameVerdict(True, False, "first")
    assert rule.judge(0, IDS, RAYS, None, QUIET) == FrameVerdict(True, True, "first")
    assert rule.judge(0, IDS, RAYS, None, None) == FrameVerdict(True, False, "first")


def test_parallax_makes_a_keyframe(rule: KeyframeRule) -> None:
    assert judge(rule, 100, 29.0).reason == ""
    assert judge(rule, 100, 31.0).reason == "parallax"


def test_the_threshold_scales_with_the_focal_length() -> None:
    rule = KeyframeRule(KeyframeConfig(parallax_px=30.0), F / 2)
    rule.accept(0, False, IDS, RAYS)
    moved = RAYS + np.array([16.0 / (F / 2), 0.0])
    assert rule.judge(100 * MS, IDS, moved, np.eye(3), BUSY).reason == "parallax"


def test_rotation_alone_makes_no_parallax(rule: KeyframeRule) -> None:
    rotation = so3_exp(np.array([0.02, 0.15, 0.1]))
    points = np.column_stack([RAYS, np.ones(100)]) @ rotation.T
    turned = points[:, :2] / points[:, 2:]
    assert rule.judge(100 * MS, IDS, turned, rotation, BUSY).reason == ""
    assert rule.judge(100 * MS, IDS, turned, None, BUSY).reason == "parallax"


def test_few_common_tracks_make_a_keyframe(rule: KeyframeRule) -> None:
    assert judge(rule, 100, tracks=40).reason == ""
    assert judge(rule, 100, tracks=39).reason == "few tracks"


def test_a_poor_scene_does_not_make_every_frame_a_keyframe() -> None:
    rule = KeyframeRule(KeyframeConfig(), F)
    rule.accept(0, False, IDS[:20], RAYS[:20])
    assert judge(rule, 100, tracks=18).reason == ""
    assert judge(rule, 100, tracks=11).reason == "few tracks"
    rule.accept(0, False, IDS[:0], RAYS[:0])
    assert judge(rule, 100, tracks=0).reason == ""
    assert judge(rule, 400, tracks=0).reason == "time"


def test_time_makes_a_keyframe_sooner_in_motion_than_at_rest(rule: KeyframeRule) -> None:
    assert judge(rule, 329, 5.0).reason == ""
    assert judge(rule, 331, 5.0).reason == "time"
    rule.accept(0, True, IDS, RAYS)
    assert judge(rule, 1999, quiet=True) == FrameVerdict(False, True, "")
    assert judge(rule, 2001, quiet=True) == FrameVerdict(True, True, "time")


def test_coming_to_rest_makes_a_keyframe_at_rest_soon(rule: KeyframeRule) -> None:
    assert judge(rule, 331, quiet=True) == FrameVerdict(True, True, "time")


def test_at_rest_needs_a_still_picture_and_a_still_gyroscope(rule: KeyframeRule) -> None:
    assert judge(rule, 100, 0.1, quiet=True).stationary
    assert not judge(rule, 100, 3.0, quiet=True).stationary
    assert not judge(rule, 100, 0.1, quiet=False).stationary
    assert not judge(rule, 100, tracks=0, quiet=True).stationary


def test_without_the_gyroscope_the_picture_decides(rule: KeyframeRule) -> None:
    assert rule.judge(100 * MS, IDS, RAYS, None, None).stationary


def test_after_a_reset_the_next_frame_is_the_first(rule: KeyframeRule) -> None:
    rule.reset()
    assert judge(rule, 100).reason == "first"
