"""Who moves too fast is told so."""

from __future__ import annotations

from vli_frontend.motion_hint import MotionHint


def text(before: int, after: int, motion_px: float, frames: int = 20) -> str:
    hint = MotionHint()
    for _ in range(frames):
        hint.add(before, after, motion_px)
    return hint.text


def test_fast_motion_that_loses_the_features_is_told() -> None:
    assert text(100, 40, 35.0) == "move slower: the image moves 35 px a frame, and 60 % of the features are lost"
    assert text(0, 0, 80.0) == "move slower: the image moves 80 px a frame, and 100 % of the features are lost"


def test_fast_motion_that_can_be_followed_and_features_lost_at_rest_are_not() -> None:
    assert text(100, 95, 35.0) == ""
    assert text(100, 0, 0.0) == ""


def test_a_twitch_is_not_told() -> None:
    hint = MotionHint()
    for frame in range(30):
        hint.add(100, 20 if frame % 10 < 3 else 98, 40.0 if frame % 10 < 3 else 2.0)
    assert hint.text == ""


def test_a_new_session_begins_without_a_hint() -> None:
    hint = MotionHint()
    for _ in range(20):
        hint.add(100, 40, 35.0)
    hint.reset()
    assert hint.text == ""
