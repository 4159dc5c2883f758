from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from imu_data import BOARD, NOISE, START_NS, Moving, imu_messages, moving
from recordings import image, write

from vli_bringup.cli import main
from vli_common.geometry import so3_log

BLANK = np.full((240, 320), 120, np.uint8)


def document(scene: Moving, imu: bool = True) -> dict[str, Any]:
    camera = scene.camera
    found: dict[str, Any] = {
        "cam0": {
            "camera_model": "pinhole",
            "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
            "distortion_model": "radtan",
            "distortion_coeffs": list(camera.coefficients),
            "resolution": [camera.width, camera.height],
            "provenance": {"date": "2026-01-01", "command": "vli calibrate camera"},
        },
        "laser0": {"plane": [0.0, -0.92, -0.391918359, 0.0142], "range_m": [0.02, 0.15]},
    }
    if imu:
        found["imu0"] = {
            "update_rate": NOISE.rate_hz,
            "accelerometer_noise_density": NOISE.accelerometer_noise_density,
            "accelerometer_random_walk": NOISE.accelerometer_random_walk,
            "gyroscope_noise_density": NOISE.gyroscope_noise_density,
            "gyroscope_random_walk": NOISE.gyroscope_random_walk,
        }
    return found


@pytest.fixture(scope="module")
def scene() -> Moving:
    return moving(seed=12, duration_s=8.0, frame_hz=10.0, lens=False)


@pytest.fixture(scope="module")
def bag(scene: Moving, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return scene.write_bag(tmp_path_factory.mktemp("moving") / "bag")


@pytest.fixture
def calibration(scene: Moving, tmp_path: Path) -> Path:
    path = tmp_path / "calibration.yaml"
    path.write_text(yaml.safe_dump(document(scene)))
    return path


def run(bag: Path, calibration: Path, *more: str) -> int:
    out = str(calibration.with_name("out.yaml"))
    return main(["calibrate", "imu-camera", str(bag), "--target", BOARD.spec, "--calib", str(calibration), "--out", out, *more])


def test_pictures_of_a_board_and_an_imu_become_a_calibration(bag, scene, calibration, tmp_path, capsys) -> None:
    assert run(bag, calibration, "--report", str(tmp_path / "report")) == 0
    out = yaml.safe_load((tmp_path / "out.yaml").read_text())
    cam0 = out["cam0"]
    T = np.array(cam0["T_cam_imu"])
    assert np.rad2deg(np.linalg.norm(so3_log(T[:3, :3] @ scene.T_cam_imu[:3, :3].T))) < 0.2
    assert np.linalg.norm(T[:3, 3] - scene.T_cam_imu[:3, 3]) < 1.5e-3
    assert cam0["timeshift_cam_imu"] == pytest.approx(scene.timeshift_s, abs=0.3e-3)
    assert cam0["intrinsics"] == document(scene)["cam0"]["intrinsics"]
    assert cam0["provenance"]["command"] == "vli calibrate camera"
    assert set(cam0["provenance"]["imu_camera"]["intervals"]) == {"rotation_deg", "translation_mm", "timeshift_ms"}
    assert out["laser0"] == document(scene)["laser0"]
    assert out["imu0"] == document(scene)["imu0"]
    summary = json.loads((tmp_path / "report" / "summary.json").read_text())
    assert summary["images_total"] == 80
    assert summary["images_used"] > 50
    assert summary["reprojection_rms_px"] < 0.5
    assert (tmp_path / "report" / "report.html").read_text().count("<svg") == 3
    text = capsys.readouterr().out
    assert "rotation vector" in text
    assert text.splitlines()[-1].startswith(("good: ", "usable: "))


def test_a_calibration_without_imu_noise_says_what_to_do(bag, scene, tmp_path, capsys) -> None:
    path = tmp_path / "calibration.yaml"
    path.write_text(yaml.safe_dump(document(scene, imu=False)))
    assert run(bag, path) == 2
    error = capsys.readouterr().err
    assert "section 'imu0' is missing" in error
    assert "make it with 'vli calibrate imu', or pass Kalibr's file with '--imu-calib'" in error
    assert error.count("\n") == 1


def test_a_bag_without_an_imu_is_refused(calibration, tmp_path, capsys) -> None:
    write(tmp_path / "bag", [(START_NS, "/camera/image_raw", image(START_NS, pixels=BLANK))])
    assert run(tmp_path / "bag", calibration) == 2
    assert "has no imu topic '/imu'" in capsys.readouterr().err


def test_a_bag_without_a_board_says_in_how_many_frames_and_why(scene, calibration, tmp_path, capsys) -> None:
    messages = list(imu_messages(scene.imu_stamps[:400], scene.imu_values[:400]))
    messages += [(ns, "/camera/image_raw", image(ns, pixels=BLANK)) for ns in scene.frame_stamps[:15]]
    write(tmp_path / "bag", sorted(messages, key=lambda item: item[0]))
    assert run(tmp_path / "bag", calibration) == 2
    error = capsys.readouterr().err
    assert "was found in '0' of 15 long frames, expected at least 40 (in 15: " in error
    assert error.count("\n") == 1


def test_images_of_another_size_are_refused(scene, calibration, tmp_path, capsys) -> None:
    messages = list(imu_messages(scene.imu_stamps[:400], scene.imu_values[:400]))
    messages += [(ns, "/camera/image_raw", image(ns, pixels=BLANK[:200])) for ns in scene.frame_stamps[:15]]
    write(tmp_path / "bag", sorted(messages, key=lambda item: item[0]))
    assert run(tmp_path / "bag", calibration) == 2
    assert "image is '320 x 200', the calibration is for 320 x 240" in capsys.readouterr().err


def test_an_unknown_kind_of_topic_is_refused(bag, calibration, capsys) -> None:
    with pytest.raises(SystemExit, match="2"):
        run(bag, calibration, "--topic", "laser=/x")
    assert "'laser=/x', expected image=/name or imu=/name" in capsys.readouterr().err


@pytest.mark.slow
def test_a_simulated_sensor_is_calibrated(tmp_path: Path) -> None:
    out = tmp_path / "board"
    assert main(["simulate", "board", "--out", str(out), "--parts", "bag", "--seed", "3", "--target", BOARD.spec]) == 0
    truth = yaml.safe_load((out / "calibration.yaml").read_text())["cam0"]
    calibrated = tmp_path / "c.yaml"
    arguments = ["--target", BOARD.spec, "--calib", str(out / "calibration.yaml"), "--out", str(calibrated)]
    assert main(["calibrate", "imu-camera", str(out / "bag"), *arguments]) == 0
    found = yaml.safe_load(calibrated.read_text())["cam0"]
    T, T_true = np.array(found["T_cam_imu"]), np.array(truth["T_cam_imu"])
    assert np.rad2deg(np.linalg.norm(so3_log(T[:3, :3] @ T_true[:3, :3].T))) <= 0.1
    assert np.linalg.norm(T[:3, 3] - T_true[:3, 3]) <= 0.5e-3
    assert abs(found["timeshift_cam_imu"] - truth["timeshift_cam_imu"]) <= 0.3e-3
