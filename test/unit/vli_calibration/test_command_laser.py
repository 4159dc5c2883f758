"""``vli calibrate laser`` as a user types it: on drawn images, on real ones, and on what cannot work."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from laser_sets import CAMERA, PLANE, board_poses, disturbed_camera, drawn

from vli_bringup.cli import main
from vli_calibration.laser_model import camera_parameters
from vli_common.camera import CameraModel

TARGET = "chessboard:9x6:0.005"
IMAGES = 10


def write_calibration(path: Path, camera: CameraModel) -> Path:
    values = camera_parameters(camera).tolist()
    cam0 = {
        "camera_model": "pinhole",
        "intrinsics": values[:4],
        "distortion_model": "radtan",
        "distortion_coeffs": values[4:],
        "resolution": [camera.width, camera.height],
        "rate_hz": 60.0,
    }
    path.write_text(yaml.safe_dump({"cam0": cam0}))
    return path


@pytest.fixture(scope="module")
def drawn_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory of images of the board with a red stripe."""
    path = tmp_path_factory.mktemp("laser")
    for index, T in enumerate(board_poses(IMAGES, np.random.default_rng(21), 0.35)):
        cv2.imwrite(str(path / f"im{index}.png"), drawn(T, index))
    return path


def calibrate(source: Path, calibration: Path, out: Path, *more: str) -> int:
    return main(["calibrate", "laser", str(source), "--target", TARGET, "--calib", str(calibration), "--out", str(out), *more])


def test_the_plane_of_drawn_images_is_written_with_its_report(
    drawn_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = write_calibration(tmp_path / "c.yaml", disturbed_camera())
    assert calibrate(drawn_set, given, tmp_path / "out.yaml", "--report", str(tmp_path / "report")) == 0
    written = yaml.safe_load((tmp_path / "out.yaml").read_text())
    plane = np.array(written["laser0"]["plane"])
    assert np.degrees(np.arccos(min(1.0, plane[:3] @ PLANE.normal))) < 0.5
    assert abs(plane[3] - PLANE.d) < 2e-4
    assert written["cam0"]["rate_hz"] == 60.0
    assert written["cam0"]["provenance"]["laser"]["note"].startswith("refined")
    assert {"date", "images", "residuals", "intervals"} <= set(written["laser0"]["provenance"])
    summary = json.loads((tmp_path / "report" / "summary.json").read_text())
    for key in ("plane_rms_mm", "plane_rms_pnp_mm", "stripe_points_total", "stripe_points_used", "loo_depth_rms_mm", "intervals"):
        assert key in summary
    assert summary["stripe_points_used"] >= 0.85 * summary["stripe_points_total"]
    assert (tmp_path / "report" / "report.html").stat().st_size > 20_000
    assert "plane RMS, joint" in capsys.readouterr().out


def test_a_camera_that_is_held_is_written_as_it_was(drawn_set: Path, tmp_path: Path) -> None:
    given = write_calibration(tmp_path / "c.yaml", CAMERA)
    assert calibrate(drawn_set, given, tmp_path / "out.yaml", "--hold-camera", "--range", "0.03", "0.12") == 0
    written = yaml.safe_load((tmp_path / "out.yaml").read_text())
    assert written["cam0"] == yaml.safe_load(given.read_text())["cam0"]
    assert written["laser0"]["range_m"] == [0.03, 0.12]


def test_images_without_a_stripe_end_with_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for index, T in enumerate(board_poses(4, np.random.default_rng(2), 0.3)):
        cv2.imwrite(str(tmp_path / f"im{index}.png"), drawn(T, index, laser=None))
    given = write_calibration(tmp_path / "c.yaml", CAMERA)
    assert calibrate(tmp_path, given, tmp_path / "out.yaml") == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert "no laser stripe found in 4 of 4 images" in error
    assert not (tmp_path / "out.yaml").exists()


def test_too_few_images_and_images_of_one_view_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    T = board_poses(1, np.random.default_rng(5), 0.2)[0]
    given = write_calibration(tmp_path / "c.yaml", CAMERA)
    for count, message in ((2, "board and stripe together show in '2' of 2 images"), (5, "nearly one line")):
        for index in range(count):
            cv2.imwrite(str(tmp_path / f"im{index}.png"), drawn(T, index))
        assert calibrate(tmp_path, given, tmp_path / "out.yaml") == 2
        assert message in capsys.readouterr().err


def test_images_of_another_camera_are_told(drawn_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from dataclasses import replace

    given = write_calibration(tmp_path / "c.yaml", replace(CAMERA, width=1280, height=720))
    assert calibrate(drawn_set, given, tmp_path / "out.yaml") == 2
    assert "'640 x 480', the calibration is for 1280 x 720" in capsys.readouterr().err


@pytest.mark.slow
def test_the_real_sensor_on_the_arm_meets_its_reference(shared_data: Path, tmp_path: Path) -> None:
    data = shared_data / "blaser_calibration"
    source, given = data / "640_unified", tmp_path / "c.yaml"
    assert main(["calibrate", "camera", str(source), "--target", TARGET, "--out", str(given)]) == 0
    assert (
        calibrate(source, given, tmp_path / "o.yaml", "--poses", str(source / "data.txt"), "--report", str(tmp_path / "r")) == 0
    )
    summary = json.loads((tmp_path / "r" / "summary.json").read_text())
    reference = json.loads((data / "reference_calibration.json").read_text())["640_unified"]["plane_jointBA"]
    assert summary["plane_rms_mm"] <= 0.040
    assert summary["stripe_points_used"] >= 0.9 * summary["stripe_points_total"]
    assert np.degrees(np.arccos(np.array(summary["plane"][:3]) @ reference["n"])) <= 0.15
    assert abs(summary["plane"][3] - reference["d_m"]) <= 1e-4
    assert summary["table_rms_mm"] <= 0.42
    assert summary["table_images"] >= 24
