"""A flat plate and a round bar: the map knows nothing of the way along them, and must not pretend to."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from vli_bringup.cli import main

SLACK_MM = 0.01
"""By so much do the errors of one scan vary with anything that changes its numbers."""


def rmse_mm(recording: Path, mode: str) -> float:
    """Return the translation RMSE of the live trajectory in a mode."""
    out, figures = recording / mode, recording / f"{mode}.json"
    calibration, truth = str(recording / "calibration.yaml"), str(recording / "truth.tum")
    assert main(["run", str(recording / "bag"), "--calib", calibration, "--out", str(out), "--mode", mode]) == 0
    assert main(["eval", str(out), "--truth", truth, "--json", str(figures)]) == 0
    return float(json.loads(figures.read_text())["translation_rmse_mm"])


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["plate", "bar"])
def test_the_map_of_a_plain_surface_does_not_make_the_trajectory_worse(scene: str, tmp_path: Path) -> None:
    recording = tmp_path / scene
    # Two passes: on the way back the map constrains the window.
    assert main(["simulate", scene, "--preset", "short", "--duration", "15", "--seed", "21", "--out", str(recording)]) == 0
    odometry, slam = rmse_mm(recording, "vli-odom"), rmse_mm(recording, "vli-slam")
    assert odometry < 0.12
    assert slam <= odometry + SLACK_MM
