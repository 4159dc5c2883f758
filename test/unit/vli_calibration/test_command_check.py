"""``vli calibrate check``: near zero with the truth, and clear words where the plane has moved."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from laser_sets import CAMERA, PLANE, board_poses, drawn

from vli_bringup.cli import main
from vli_calibration.laser_model import LaserPlane, camera_parameters

TARGET = "chessboard:9x6:0.005"


@pytest.fixture(scope="module")
def drawn_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory of images of the board with a red stripe."""
    path = tmp_path_factory.mktemp("check")
    for index, T in enumerate(board_poses(5, np.random.default_rng(31), 0.3)):
        cv2.imwrite(str(path / f"im{index}.png"), drawn(T, index))
    return path


def run(source: Path, folder: Path, plane: LaserPlane | None) -> tuple[int, dict[str, object]]:
    values = camera_parameters(CAMERA).tolist()
    document: dict[str, object] = {
        "cam0": {
            "camera_model": "pinhole",
            "intrinsics": values[:4],
            "distortion_model": "radtan",
            "distortion_coeffs": values[4:],
            "resolution": [640, 480],
        }
    }
    if plane is not None:
        document["laser0"] = {"plane": plane.vector.tolist(), "range_m": [0.02, 0.15]}
    (folder / "c.yaml").write_text(yaml.safe_dump(document))
    report = folder / "report"
    code = main(
        ["calibrate", "check", str(source), "--target", TARGET, "--calib", str(folder / "c.yaml"), "--report", str(report)]
    )
    return code, json.loads((report / "summary.json").read_text()) if code == 0 else {}


def test_with_the_true_calibration_the_board_is_flat_and_in_its_place(drawn_set: Path, tmp_path: Path) -> None:
    code, summary = run(drawn_set, tmp_path, PLANE)
    assert code == 0
    assert summary["verdict"] == "good"
    assert abs(summary["bias_mm"]) < 0.1
    assert 0 < summary["flatness_rms_mm"] < 0.3
    assert sum(row["points"] for row in summary["by_distance"]) == summary["stripe_points_used"]


def test_a_plane_that_has_moved_shows_as_bias_and_in_words(
    drawn_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, summary = run(drawn_set, tmp_path, PLANE.moved(np.array([0.0, 0.02, 8e-4])))
    assert code == 0
    assert summary["verdict"] == "bad"
    assert abs(summary["bias_mm"]) > 0.5
    assert "re-run 'vli calibrate camera'" in capsys.readouterr().out


def test_a_calibration_without_a_laser_is_told(drawn_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _ = run(drawn_set, tmp_path, None)
    assert code == 2
    assert "'laser0' is missing; make it with 'vli calibrate laser'" in capsys.readouterr().err
