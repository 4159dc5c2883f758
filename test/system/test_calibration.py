"""``vli calibrate`` as a user types it: a simulated set from the first command to the last, and input that is no good.

What cannot be used is refused in one line with exit code 2, and leaves the calibration file as it was.
"""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest
import yaml
from tiny_bag import TinyBag

from vli_bringup.cli import main
from vli_common.calibration import load_calibration
from vli_common.geometry import inverse, so3_log
from vli_common.types import Mode

BOARD = "chessboard:9x6:0.005"
IMAGES = "12"


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Return a directory with camera/, laser/ and the truth, as ``vli simulate board`` writes them."""
    directory = tmp_path_factory.mktemp("simulated") / "set"
    assert (
        main(["simulate", "board", "--out", str(directory), "--seed", "5", "--images", IMAGES, "--parts", "camera", "laser"]) == 0
    )
    return directory


@pytest.fixture(scope="module")
def calibrated(simulated, tmp_path_factory):
    """Return the directory of a calibration that camera and laser commands made, with their reports."""
    directory = tmp_path_factory.mktemp("calibrated")
    file = directory / "scanner.yaml"
    assert calibrate("camera", simulated / "camera", file, "--report", directory / "camera") == 0
    assert calibrate("laser", simulated / "laser", file, "--calib", file, "--report", directory / "laser") == 0
    return directory


def calibrate(what, source, out, *options):
    """Run a command on the standard board."""
    words = ["calibrate", what, source, "--target", BOARD, "--out", out, *options]
    return main([str(word) for word in words])


@pytest.fixture
def refused(tmp_path, capsys):
    """Return a function that runs ``vli calibrate``, expects a refusal, and returns its line; nothing may be written."""

    def run(*words):
        capsys.readouterr()
        before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
        assert main(["calibrate", *map(str, words)]) == 2
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.count("\n") == 1
        assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
        return captured.err

    return run


@pytest.fixture
def some(simulated, tmp_path):
    """Return a function that copies the first images of a part into a directory of the test."""

    def copy(part, count, pattern="*"):
        directory = tmp_path / f"some_{part}"
        directory.mkdir()
        for file in sorted((simulated / part).glob(pattern))[:count]:
            shutil.copy(file, directory)
        return directory

    return copy


def test_camera_and_laser_are_found_as_they_are(simulated, calibrated):
    found = load_calibration(calibrated / "scanner.yaml", Mode.VL)
    truth = load_calibration(simulated / "calibration.yaml", Mode.VL)
    assert found.camera.fx == pytest.approx(truth.camera.fx, rel=0.005)
    assert float(found.laser.normal @ truth.laser.normal) > np.cos(np.deg2rad(0.3))
    assert found.laser.d == pytest.approx(truth.laser.d, abs=2e-4)


@pytest.mark.parametrize("what", ["camera", "laser"])
def test_each_report_says_what_the_summary_says(calibrated, what):
    summary = json.loads((calibrated / what / "summary.json").read_text())
    page = (calibrated / what / "report.html").read_text()
    assert summary["images_used"] > 0.6 * summary["images_total"]
    assert summary["verdict"] in ("good", "usable")
    assert f'class="verdict {summary["verdict"]}"' in page
    assert all(low < high for low, high in summary["intervals"].values())


def test_the_file_says_where_each_section_comes_from(calibrated):
    document = yaml.safe_load((calibrated / "scanner.yaml").read_text())
    for section in ("cam0", "laser0"):
        assert "vli calibrate" in document[section]["provenance"]["command"]
        assert "date" in document[section]["provenance"]


def test_check_finds_the_board_flat(simulated, calibrated, tmp_path, capsys):
    capsys.readouterr()
    words = ["calibrate", "check", simulated / "laser", "--target", BOARD, "--calib", calibrated / "scanner.yaml"]
    assert main([*map(str, words), "--report", str(tmp_path / "check")]) == 0
    assert "good" in capsys.readouterr().out
    assert (tmp_path / "check" / "report.html").is_file()


@pytest.mark.slow
def test_camera_against_imu_from_a_moving_board(tmp_path):
    words = ["simulate", "board", "--out", tmp_path / "set", "--seed", "3", "--parts", "bag", "--duration", "12"]
    assert main([*map(str, words), "--resolution", "320x240"]) == 0
    assert (
        calibrate("imu-camera", tmp_path / "set" / "bag", tmp_path / "c.yaml", "--calib", tmp_path / "set" / "calibration.yaml")
        == 0
    )
    found = load_calibration(tmp_path / "c.yaml", Mode.VI)
    truth = load_calibration(tmp_path / "set" / "calibration.yaml", Mode.VI)
    error = inverse(truth.T_cam_imu) @ found.T_cam_imu
    assert np.linalg.norm(so3_log(error[:3, :3])) < np.deg2rad(0.1)
    assert np.linalg.norm(error[:3, 3]) < 1e-3
    assert abs(found.timeshift_ns - truth.timeshift_ns) < 300_000


def test_a_board_is_printed(tmp_path):
    assert main(["calibrate", "target", BOARD, "--out", str(tmp_path / "board.pdf")]) == 0
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")


def test_no_board_says_in_how_many_images_and_why_and_shows_one(tmp_path, capsys):
    for index in range(6):
        noise = np.random.default_rng(index).integers(90, 160, (240, 320), dtype=np.uint8)
        cv2.imwrite(str(tmp_path / f"{index}.png"), noise)
    report = tmp_path / "report"
    assert calibrate("camera", tmp_path, tmp_path / "c.yaml", "--report", report) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert "is found in '0' of 6 images" in line
    (example,) = report.iterdir()
    assert str(example) in line
    assert cv2.imread(str(example)) is not None
    assert not (tmp_path / "c.yaml").exists()


def test_another_board_than_stated_is_named(some, tmp_path, capsys):
    words = ["camera", some("camera", 6), "--target", "chessboard:8x5:0.005", "--out", tmp_path / "c.yaml"]
    assert main(["calibrate", *map(str, words)]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert "--target chessboard:9x6:0.005" in line
    assert not (tmp_path / "c.yaml").exists()


def test_too_few_views(refused, some, tmp_path):
    line = refused("camera", some("camera", 3), "--target", BOARD, "--out", tmp_path / "c.yaml")
    assert "holds '3' images, expected 5 or more" in line


def test_views_that_are_all_parallel(refused, tmp_path):
    words = ["simulate", "board", "--out", tmp_path / "flat", "--seed", "2", "--images", "10", "--tilt", "0", "--parts", "camera"]
    assert main([*map(str, words), "--resolution", "320x240"]) == 0
    line = refused("camera", tmp_path / "flat" / "camera", "--target", BOARD, "--out", tmp_path / "c.yaml")
    assert "take views tilted by 20 to 45 degrees" in line


def test_a_target_that_is_none(refused, simulated, tmp_path):
    assert "expected chessboard:" in refused("camera", simulated / "camera", "--target", "chess", "--out", tmp_path / "c.yaml")


def test_a_file_that_is_no_calibration_is_not_replaced(refused, some, tmp_path):
    (tmp_path / "notes.txt").write_text("remember the milk")
    line = refused("camera", some("camera", 6), "--target", BOARD, "--out", tmp_path / "notes.txt")
    assert "expected sections cam0, imu0, laser0" in line


def test_a_broken_image_is_named(refused, some, tmp_path):
    directory = some("camera", 8)
    file = directory / "003.png"
    file.write_bytes(file.read_bytes()[:2000])
    assert "'003.png'" in refused("camera", directory, "--target", BOARD, "--out", tmp_path / "c.yaml")


def test_an_imu_that_was_not_at_rest_long_enough(refused, tmp_path):
    bag = TinyBag(image_topics=()).write(tmp_path / "bag")
    assert "at rest" in refused("imu", bag, "--out", tmp_path / "c.yaml")


def test_laser_off(refused, some, calibrated, tmp_path):
    directory = some("camera", 6)
    shutil.copy(calibrated / "scanner.yaml", tmp_path / "c.yaml")
    line = refused("laser", directory, "--target", BOARD, "--calib", tmp_path / "c.yaml", "--out", tmp_path / "c.yaml")
    assert "no laser stripe found in 6 of 6 images" in line


def test_a_laser_without_a_camera_to_see_it(refused, simulated, tmp_path):
    line = refused("laser", simulated / "laser", "--target", BOARD, "--calib", tmp_path / "no.yaml", "--out", tmp_path / "c.yaml")
    assert "make one with 'vli calibrate camera" in line


def test_a_check_without_a_plane(refused, simulated, calibrated, tmp_path):
    document = yaml.safe_load((calibrated / "scanner.yaml").read_text())
    del document["laser0"]
    (tmp_path / "lens.yaml").write_text(yaml.safe_dump(document))
    line = refused("check", simulated / "laser", "--target", BOARD, "--calib", tmp_path / "lens.yaml")
    assert "make it with 'vli calibrate laser'" in line


def write_poses(path, names):
    path.write_text("".join(f"[0.0, 0.0, 0.{index:02d}]\n[0.0, 0.0, 0.0, 1.0]\n{name}\n" for index, name in enumerate(names)))
    return path


def test_poses_missing_or_out_of_order(refused, some, calibrated, tmp_path):
    directory = some("laser", 12)
    names = sorted(file.name for file in directory.iterdir() if file.stem.endswith("_long"))
    words = ["laser", directory, "--target", BOARD, "--calib", calibrated / "scanner.yaml", "--out", tmp_path / "c.yaml"]
    poses = write_poses(tmp_path / "data.txt", names[:-1])
    assert f"'{names[-1]}' of 6 images without a pose" in refused(*words, "--poses", poses)
    lines = write_poses(tmp_path / "data.txt", names).read_text().splitlines()
    lines[3], lines[4] = lines[4], lines[3]
    poses.write_text("\n".join(lines))
    assert "line 4 is '[0.0, 0.0, 0.0, 1.0]', expected the position" in refused(*words, "--poses", poses)
    assert "no such file" in refused(*words, "--poses", tmp_path / "none.txt")
