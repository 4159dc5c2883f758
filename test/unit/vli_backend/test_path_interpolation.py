"""Stripes are between long frames, and a hand does not move in straight lines between those."""

from __future__ import annotations

import numpy as np
import pytest

from vli_backend.path_interpolation import interpolate_path
from vli_common.geometry import interpolate, pose, so3_exp, so3_log

PERIOD_NS = 33_333_333


def stamps_of(count: int) -> np.ndarray:
    return np.arange(count) * PERIOD_NS


def trembling(stamps: np.ndarray, hertz: float = 8.0) -> np.ndarray:
    """A hand that moves on while it trembles by 0.5 mm and 1°."""
    phase = 2 * np.pi * hertz * stamps * 1e-9
    turn = np.radians(1.0) * np.stack([np.sin(phase), np.cos(1.1 * phase), np.sin(0.7 * phase)], axis=1)
    place = (
        5e-4 * np.stack([np.cos(phase), np.sin(phase), np.sin(0.9 * phase)], axis=1) + [[0.01, 0.0, 0.0]] * stamps[:, None] * 1e-9
    )
    return np.stack([pose(so3_exp(w), t) for w, t in zip(turn, place, strict=True)])


def errors(found: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    turns = np.linalg.norm(so3_log(found[:, :3, :3].transpose(0, 2, 1) @ true[:, :3, :3]), axis=1)
    return float(np.sqrt((turns**2).mean())), float(np.sqrt(((found - true)[:, :3, 3] ** 2).sum(axis=1).mean()))


def test_a_cubic_path_is_met_exactly():
    stamps = stamps_of(6)
    wanted = stamps[1:-2] + PERIOD_NS // 3

    def path(at):
        s = at * 1e-9
        return np.stack([pose(np.eye(3), np.array([x, x**2, 5 * x**3 - x])) for x in s])

    np.testing.assert_allclose(interpolate_path(stamps, path(stamps), wanted), path(wanted), atol=1e-12)


def test_of_a_tremor_less_than_half_is_missed_of_what_straight_lines_miss():
    stamps = stamps_of(31)
    wanted = stamps[:-1] + PERIOD_NS // 2
    path = trembling(stamps)
    lines = errors(interpolate(path[:-1], path[1:], np.full(30, 0.5)), trembling(wanted))
    cubics = errors(interpolate_path(stamps, path, wanted), trembling(wanted))
    assert cubics[0] < 0.5 * lines[0]
    assert cubics[1] < 0.5 * lines[1]


def test_the_poses_of_the_path_are_on_it():
    stamps = stamps_of(5)
    path = trembling(stamps)
    np.testing.assert_allclose(interpolate_path(stamps, path, stamps), path, atol=1e-12)


@pytest.mark.parametrize("kept", [[0, 1], [0, 2, 3]])
def test_lines_do_where_a_path_is_short_or_frames_are_missing(kept):
    stamps = stamps_of(4)[kept]
    path = trembling(stamps)
    wanted = np.array([PERIOD_NS // 2])
    expected = interpolate(path[:1], path[1:2], wanted / stamps[1])
    np.testing.assert_allclose(interpolate_path(stamps, path, wanted), expected, atol=1e-15)


def test_nothing_wanted_is_nothing_found():
    assert interpolate_path(stamps_of(3), trembling(stamps_of(3)), np.empty(0, np.int64)).shape == (0, 4, 4)
