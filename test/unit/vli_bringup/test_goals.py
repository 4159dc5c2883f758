"""The table of goals: means of sizes, marks where a goal is missed, and blanks where nothing was measured."""

from __future__ import annotations

import pytest
from goals import FULL, GOALS, MODES, NO_IMU, ODOMETRY, SOURCES, Goal, mean_size, row

RMSE = Goal(FULL, "RMSE, mm", "translation_rmse_mm", 0.2)


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_errors_of_opposite_sign_do_not_make_up_for_each_other() -> None:
    assert mean_size([0.1, -0.3]) == pytest.approx(0.2)


def test_a_line_shows_the_mean_of_the_seeds_in_each_mode_and_marks_a_missed_goal() -> None:
    runs = {ODOMETRY: [{"translation_rmse_mm": 0.1}, {"translation_rmse_mm": 0.2}], "vli-slam": [{"translation_rmse_mm": 0.5}]}
    assert cells(row(RMSE, runs.__getitem__)) == ["six passes: RMSE, mm", "≤ 0.2", "0.15", "0.5 ✗", "", ""]


def test_a_run_without_a_figure_is_a_failure_not_a_gap() -> None:
    runs = [{"translation_rmse_mm": 0.1}, {}]
    assert cells(row(RMSE, lambda _: runs))[2] == "1 of 2 without a figure ✗"


@pytest.mark.parametrize(("value", "met"), [(0.9, False), (1.0, True), (6.0, True), (6.1, False)])
def test_a_nees_may_be_too_small_as_well(value: float, met: bool) -> None:
    (goal,) = (goal for goal in GOALS if goal.key == "position_nees" and goal.source is FULL)
    assert goal.met(value) is met


def test_what_is_only_shown_is_always_met_and_names_are_unique() -> None:
    assert all(goal.met(1e9) for goal in GOALS if goal.most is None)
    assert len({source.name for source in SOURCES}) == len(SOURCES)
    assert {mode for goal in GOALS for mode in goal.modes} == set(MODES)
    assert NO_IMU in MODES
