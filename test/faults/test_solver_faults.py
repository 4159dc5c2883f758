"""F21: a solver that fails."""

from __future__ import annotations

import numpy as np
import pytest
from runs import rmse_mm
from streams import until

from vli_backend import estimator, frame_tracker, smoother
from vli_common.types import TrackingState

INITIALISING, TRACKING = TrackingState.INITIALISING, TrackingState.TRACKING
DEGRADED, LOST = TrackingState.DEGRADED, TrackingState.LOST
INDETERMINATE = "Indeterminant linear system detected while working near variable 'x7'"


class Failing:
    """Stands in for a function, and fails at some of its calls.

    Args:
        original: that it calls otherwise.
        at: which calls fail.
        error: what they raise.
    """

    def __init__(self, original, at, error):
        self.original, self.at, self.error, self.calls = original, at, error, 0

    def __call__(self, *args, **kwargs):
        self.calls += 1
        if self.calls - 1 in self.at:
            raise self.error
        return self.original(*args, **kwargs)


@pytest.fixture
def short(first_part):
    return until(first_part, 3.5)


@pytest.mark.parametrize(
    ("place", "name", "at", "error"),
    [
        (smoother.GtsamSmoother, "solve", {9, 10}, smoother.SmootherError(INDETERMINATE)),
        (smoother.GtsamSmoother, "marginalise_oldest", {1}, smoother.SmootherError(INDETERMINATE)),
        (estimator, "condense", {30}, np.linalg.LinAlgError("Singular matrix")),
        (frame_tracker, "solve_frame_pose", {60}, np.linalg.LinAlgError("Array must not contain infs or NaNs")),
    ],
    ids=["solve", "marginalisation", "cheirality", "frame"],
)
def test_f21_where_the_solver_fails_a_new_window_goes_on(short, truth, scan, monkeypatch, place, name, at, error):
    failing = Failing(getattr(place, name), at, error)
    monkeypatch.setattr(place, name, lambda *args, **kwargs: failing(*args, **kwargs))
    found = scan(short)
    assert failing.calls > max(at)
    assert found.states == [INITIALISING, TRACKING, DEGRADED, TRACKING]
    told = [reason for reason in found.reasons if "solver failed" in reason]
    assert told == [f"solver failed, the window begins anew: {error}"]
    assert (found.count("solver_failures"), found.count("windows_renewed")) == (1, 1)
    assert rmse_mm(found.live(), truth) < 0.05


@pytest.mark.parametrize("name", ["solve", "newest_covariance"])
def test_f21_a_keyframe_that_the_solver_fails_on_once_is_held_weakly(short, truth, scan, monkeypatch, name):
    failing = Failing(getattr(smoother.GtsamSmoother, name), {9}, smoother.SmootherError(INDETERMINATE))
    monkeypatch.setattr(smoother.GtsamSmoother, name, lambda *args: failing(*args))
    found = scan(short)
    assert failing.calls > 9
    assert found.states == [INITIALISING, TRACKING, DEGRADED, TRACKING]
    assert f"solver failed, the keyframe is held weakly: {INDETERMINATE}" in found.reasons
    assert [found.count(key) for key in ("solver_rescues", "solver_failures", "windows_renewed")] == [1, 0, 0]
    assert rmse_mm(found.live(), truth) < 0.05


def test_f21_a_solver_that_goes_on_failing_is_lost_and_starts_again(first_part, truth, scan, monkeypatch):
    failing = Failing(smoother.GtsamSmoother.solve, {9, 10, 11, 12}, smoother.SmootherError(INDETERMINATE))
    monkeypatch.setattr(smoother.GtsamSmoother, "solve", lambda *args: failing(*args))
    found = scan(first_part)
    assert found.states == [INITIALISING, TRACKING, DEGRADED, TRACKING, LOST, TRACKING]
    assert f"solver failed: {INDETERMINATE}" in found.reasons
    assert found.count("solver_failures") == 2
    back = next(k for k, output in enumerate(found.outputs) if output.state is LOST)
    assert rmse_mm(found.live(found.time_s(found.outputs[back])), truth) < 0.1
