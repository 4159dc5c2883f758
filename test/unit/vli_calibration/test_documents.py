from __future__ import annotations

import copy

import pytest
import yaml

from vli_calibration.documents import check_target_file, read_document, save_document, write_document
from vli_common.calibration import load_calibration
from vli_common.errors import CalibrationError, OutputError
from vli_common.types import Mode

CAMERA = {
    "camera_model": "pinhole",
    "intrinsics": [600.0, 600.0, 320.0, 240.0],
    "distortion_model": "radtan",
    "distortion_coeffs": [0.01, 0.0, 0.0, 0.0],
    "resolution": [640, 480],
}
LASER = {"plane": [0.0, -0.9, -0.4358898943540674, 0.016], "range_m": [0.02, 0.15]}
KALIBR = {
    "cam0": {
        **CAMERA,
        "cam_overlaps": [],
        "rostopic": "/camera/image_raw",
        "T_cam_imu": [[1.0, 0.0, 0.0, 0.01], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
    },
    "imu0": {
        "update_rate": 200.0,
        "accelerometer_noise_density": 2e-3,
        "accelerometer_random_walk": 3e-4,
        "gyroscope_noise_density": 2e-4,
        "gyroscope_random_walk": 2e-5,
        "rostopic": "/imu",
        "time_offset": 0.0,
    },
}


@pytest.fixture
def kalibr(tmp_path):
    path = tmp_path / "camchain.yaml"
    path.write_text(yaml.safe_dump(KALIBR))
    return path


def test_a_first_section_makes_a_file_that_is_read_again(tmp_path):
    path = tmp_path / "new" / "c.yaml"
    write_document(path, "cam0", CAMERA, {"images": 14})
    assert load_calibration(path, mode=None).camera.fx == 600.0
    assert read_document(path)["cam0"]["provenance"]["images"] == 14
    assert "date" in read_document(path)["cam0"]["provenance"]


def test_an_imu_alone_is_written_too(tmp_path):
    write_document(tmp_path / "c.yaml", "imu0", KALIBR["imu0"], {})
    assert read_document(tmp_path / "c.yaml")["imu0"]["update_rate"] == 200.0


def test_other_sections_and_kalibrs_keys_are_kept(kalibr, tmp_path):
    out = tmp_path / "c.yaml"
    write_document(out, "cam0", {**CAMERA, "intrinsics": [610.0, 610.0, 320.0, 240.0]}, {}, base=kalibr)
    write_document(out, "laser0", LASER, {"residuals": {"plane_rms_mm": 0.04}})
    document = read_document(out)
    assert document["cam0"]["intrinsics"][0] == 610.0
    for key in ("rostopic", "cam_overlaps", "T_cam_imu"):
        assert document["cam0"][key] == KALIBR["cam0"][key]
    assert document["imu0"] == KALIBR["imu0"]
    assert load_calibration(out, Mode.VLI_SLAM).laser is not None
    assert yaml.safe_load(kalibr.read_text()) == KALIBR


def test_two_commands_that_write_one_section_keep_each_others_record(tmp_path):
    path = tmp_path / "c.yaml"
    write_document(path, "cam0", CAMERA, {"images": 1})
    write_document(path, "cam0", {"timeshift_cam_imu": 0.01}, {"images": 2}, part="imu_camera")
    write_document(path, "cam0", CAMERA, {"images": 3})
    provenance = read_document(path)["cam0"]["provenance"]
    assert (provenance["images"], provenance["imu_camera"]["images"]) == (3, 2)
    assert read_document(path)["cam0"]["timeshift_cam_imu"] == 0.01


def test_an_impossible_section_leaves_the_file_as_it_was(kalibr):
    before = kalibr.read_bytes()
    with pytest.raises(CalibrationError, match=r"laser plane normal has norm '2\.0'"):
        write_document(kalibr, "laser0", {**LASER, "plane": [0, 0, 2, 0.1]}, {})
    with pytest.raises(CalibrationError, match=r"unknown key 'cam0\.intrinsic'"):
        write_document(kalibr, "cam0", {"intrinsic": [1]}, {})
    assert kalibr.read_bytes() == before
    assert [item.name for item in kalibr.parent.iterdir()] == [kalibr.name]


def test_a_file_that_is_no_calibration_is_not_replaced(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("remember the milk")
    with pytest.raises(CalibrationError, match="holds 'str', expected sections"):
        write_document(path, "cam0", CAMERA, {})
    assert path.read_text() == "remember the milk"


def test_a_base_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(CalibrationError, match="no such file; make one with 'vli calibrate camera"):
        write_document(tmp_path / "c.yaml", "laser0", LASER, {}, base=tmp_path / "none.yaml")


def test_a_place_that_cannot_be_written_is_an_error_and_leaves_nothing(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "c.yaml").mkdir()
    with pytest.raises(OutputError, match="cannot be written"):
        write_document(tmp_path / "file" / "c.yaml", "cam0", CAMERA, {})
    with pytest.raises(OutputError, match="cannot be written"):
        save_document(tmp_path / "c.yaml", {"cam0": CAMERA})
    assert {item.name for item in tmp_path.iterdir()} == {"file", "c.yaml"}


def test_the_plane_is_written_with_a_positive_distance_and_the_input_is_left_alone(tmp_path):
    values = {**LASER, "plane": [-value for value in LASER["plane"]]}
    before = copy.deepcopy(values)
    write_document(tmp_path / "c.yaml", "laser0", values, {})
    assert read_document(tmp_path / "c.yaml")["laser0"]["plane"][3] == 0.016
    assert values == before


def test_a_file_that_could_not_be_written_is_told_before_anything_is_computed(tmp_path):
    with pytest.raises(OutputError, match="is a directory, expected the calibration file to write"):
        check_target_file(tmp_path)
    broken = tmp_path / "broken.yaml"
    broken.write_text("cam0: [")
    with pytest.raises(CalibrationError, match=r"broken\.yaml"):
        check_target_file(broken)
    check_target_file(broken, base=tmp_path / "other.yaml")
    check_target_file(tmp_path / "new.yaml")
