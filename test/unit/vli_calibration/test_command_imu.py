from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from imu_data import NOISE, imu_messages, rest
from recordings import START_NS as IMAGE_START_NS
from recordings import image, write

from vli_bringup.cli import main


@pytest.fixture(scope="module")
def rest_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return two minutes of an IMU at rest, without images."""
    path = tmp_path_factory.mktemp("imu") / "rest"
    write(path, imu_messages(*rest(120.0, 1)))
    return path


def test_the_section_is_written_beside_what_the_file_held(rest_bag: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "calibration.yaml"
    out.write_text("laser0:\n  plane: [0.0, -0.92, -0.391918359, 0.0142]\n  range_m: [0.02, 0.15]\n")
    assert main(["calibrate", "imu", str(rest_bag), "--out", str(out), "--report", str(tmp_path / "report")]) == 0
    document = yaml.safe_load(out.read_text())
    assert document["laser0"]["range_m"] == [0.02, 0.15]
    imu0 = document["imu0"]
    assert imu0["update_rate"] == 200.0
    assert imu0["accelerometer_noise_density"] == pytest.approx(NOISE.accelerometer_noise_density, rel=0.1)
    assert imu0["gyroscope_noise_density"] == pytest.approx(NOISE.gyroscope_noise_density, rel=0.1)
    low, high = imu0["provenance"]["intervals"]["gyroscope_noise_density"]
    assert low < imu0["gyroscope_noise_density"] < high
    assert (tmp_path / "report" / "report.html").stat().st_size > 20_000
    summary = json.loads((tmp_path / "report" / "summary.json").read_text())
    assert summary["samples"] == 24_000
    assert summary["gyroscope_noise_density"] == imu0["gyroscope_noise_density"]
    text = capsys.readouterr().out
    assert "noise density" in text
    assert text.splitlines()[-1].startswith("usable: ")


def test_two_minutes_write_an_upper_bound_and_flag_it(rest_bag: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "calibration.yaml"
    assert main(["calibrate", "imu", str(rest_bag), "--out", str(out)]) == 0
    imu0 = yaml.safe_load(out.read_text())["imu0"]
    assert "gyroscope_random_walk" in imu0["provenance"]["upper_bounds"]
    assert imu0["gyroscope_random_walk"] >= NOISE.gyroscope_random_walk
    assert "record at rest for about" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: write(path, ((IMAGE_START_NS, "/camera/image_raw", image(IMAGE_START_NS)),)), "has no imu topic '/imu'"),
        (lambda path: write(path, imu_messages(*rest(5.0, 0))), "recorded for '5.0' s, expected at least 60 s"),
        (lambda path: write(path, imu_messages(*rest(0.02, 0))), "holds '4' usable samples of 4"),
        (lambda path: path.mkdir(), "holds no .mcap or .db3 file"),
        (lambda path: None, "does not exist"),
    ],
)
def test_a_bag_that_cannot_serve_is_one_line_and_exit_code_2(make, message: str, tmp_path: Path, capsys) -> None:
    make(tmp_path / "bag")
    assert main(["calibrate", "imu", str(tmp_path / "bag"), "--out", str(tmp_path / "c.yaml")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "c.yaml").exists()


def test_motion_is_named_with_its_time(tmp_path: Path, capsys) -> None:
    stamps, values = rest(100.0, 3)
    for second in (20, 45, 70):
        values[200 * second : 200 * second + 100, :3] += 0.2 * np.sin(np.linspace(0, 12, 100))[:, None]
    write(tmp_path / "bag", imu_messages(stamps, values))
    assert main(["calibrate", "imu", str(tmp_path / "bag"), "--out", str(tmp_path / "c.yaml")]) == 2
    error = capsys.readouterr().err
    assert "motion at " in error
    assert error.count("\n") == 1
