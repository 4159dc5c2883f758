"""``vli calibrate camera`` as it is typed: real images, the files that it leaves, and what it says to bad input."""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from board_scenes import BOARD, RADTAN4, board_pose_at, picture

from vli_calibration.commands import camera, target
from vli_common.calibration import load_document
from vli_common.errors import InputError


def calibrate(*words: object) -> int:
    """Run the command in this process; return its exit code."""
    parser = argparse.ArgumentParser()
    camera.add_arguments(parser)
    return camera.run(parser.parse_args([str(word) for word in words]))


def copy_images(source: Path, to: Path, names: list[str]) -> Path:
    to.mkdir()
    for name in names:
        shutil.copy(source / name, to / name)
    return to


@pytest.fixture
def real(shared_data: Path) -> Path:
    return shared_data / "blaser_calibration"


def test_images_with_a_laser_on_the_board_give_the_reference_camera(
    real: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, report = tmp_path / "c.yaml", tmp_path / "report"
    out.write_text("laser0:\n  plane: [0.0177, -0.8968, -0.4421, 0.01608]\n  range_m: [0.02, 0.15]\n")
    assert calibrate(real / "640_unified", "--target", "chessboard:9x6:0.005", "--out", out, "--report", report) == 0
    figures = json.loads((report / "summary.json").read_text())
    assert figures["images_total"] == 25
    assert figures["images_used"] >= 14
    assert figures["corners_used"] >= 690
    assert figures["reprojection_rms_px"] <= 0.25
    assert {item["name"] for item in figures["rejected"]} == {f"im{i}.png" for i in range(13, 24)}
    reference = json.loads((real / "reference_calibration.json").read_text())["640_unified"]["K_jointBA"]
    for name, expected in (("fx", reference[0][0]), ("fy", reference[1][1]), ("cx", reference[0][2]), ("cy", reference[1][2])):
        low, high = figures["intervals"][name]
        assert low < expected < high
    document = load_document(out)
    assert document["laser0"]["range_m"] == [0.02, 0.15]
    assert document["cam0"]["resolution"] == [640, 480]
    assert len(document["cam0"]["provenance"]["images"]) >= 14
    page = (report / "report.html").read_text()
    assert "im13.png: too dark" in page
    assert "measure the print with a ruler" in capsys.readouterr().out


def test_a_wide_lens_gets_a_model_that_fits_it(real: Path, tmp_path: Path) -> None:
    out, report = tmp_path / "c.yaml", tmp_path / "report"
    assert calibrate(real / "handheld_1280x720", "--target", "chessboard:9x6:0.03", "--out", out, "--report", report) == 0
    figures = json.loads((report / "summary.json").read_text())
    assert figures["images_used"] == 36
    assert figures["reprojection_rms_px"] <= 0.45
    assert figures["model"] != "radtan4"
    assert yaml.safe_load(out.read_text())["cam0"]["distortion_model"] == figures["distortion_model"]


def test_another_boards_size_is_named_and_an_example_written(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    rng = np.random.default_rng(0)
    for i in range(5):
        T = board_pose_at(BOARD, 0.1, rng.uniform(-0.4, 0.4, 2), np.zeros(2), 0.2 * i)
        cv2.imwrite(str(images / f"im{i}.png"), picture(BOARD, RADTAN4, T, rng))
    with pytest.raises(InputError) as error:
        calibrate(images, "--target", "chessboard:8x5:0.005", "--out", tmp_path / "c.yaml")
    assert "found in '0' of 5 images" in str(error.value)
    assert "5 × 9x6 inner corners to be seen instead of 8x5" in str(error.value)
    assert "try --target chessboard:9x6:0.005" in str(error.value)
    assert len(list(tmp_path.glob("no_board_im*.png"))) == 1
    assert not (tmp_path / "c.yaml").exists()


def test_images_without_a_board_are_counted_by_reason(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for i in range(6):
        cv2.imwrite(str(images / f"im{i}.png"), np.full((240, 320), 5 if i < 4 else 120, np.uint8))
    with pytest.raises(
        InputError, match=r"found in '0' of 6 images .*4 × too dark, 2 × no contrast.*an example is '.*no_board_im"
    ) as error:
        calibrate(images, "--target", "chessboard:9x6:0.005", "--out", tmp_path / "c.yaml", "--report", tmp_path / "report")
    assert "\n" not in str(error.value)
    assert list((tmp_path / "report").glob("no_board_im*.png"))


def test_views_that_are_too_few_or_parallel_are_refused(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    rng = np.random.default_rng(1)
    for i in range(6):
        T = board_pose_at(BOARD, 0.1 + 0.005 * i, np.zeros(2), np.array([0.02 * i - 0.05, 0.0]))
        cv2.imwrite(str(images / f"im{i}.png"), picture(BOARD, RADTAN4, T, rng))
    with pytest.raises(InputError, match="all 6 views are parallel"):
        calibrate(images, "--target", "chessboard:9x6:0.005", "--out", tmp_path / "c.yaml", "--model", "equidistant")
    few = copy_images(images, tmp_path / "few", ["im0.png", "im1.png"])
    with pytest.raises(InputError, match="holds '2' images, expected 5 or more"):
        calibrate(few, "--target", "chessboard:9x6:0.005", "--out", tmp_path / "c.yaml")


def test_the_target_is_written_as_a_pdf_and_nothing_else(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    target.add_arguments(parser)
    out = tmp_path / "board.pdf"
    assert target.run(parser.parse_args(["chessboard:9x6:0.005", "--out", str(out)])) == 0
    assert out.read_bytes().startswith(b"%PDF")
    assert "the ruler must measure 150 mm" in capsys.readouterr().out
    with pytest.raises(InputError, match="is no name of a PDF"):
        target.run(parser.parse_args(["chessboard:9x6:0.005", "--out", str(tmp_path / "board.png")]))
