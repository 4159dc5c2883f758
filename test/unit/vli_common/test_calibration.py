"""The calibration file: what is read, what is refused, and what the refusal says."""

from __future__ import annotations

import copy
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from vli_common.calibration import load_calibration, parse_calibration, to_yaml
from vli_common.errors import CalibrationError
from vli_common.types import Mode

DOCUMENT: dict[str, Any] = {
    "cam0": {
        "camera_model": "pinhole",
        "intrinsics": [362.4, 363.1, 323.7, 236.9],
        "distortion_model": "radtan",
        "distortion_coeffs": [-0.118, 0.017, 0.0007, -0.0005],
        "resolution": [640, 480],
        "rate_hz": 60.0,
        "T_cam_imu": [[0.0, 1.0, 0.0, 0.01], [1.0, 0.0, 0.0, 0.02], [0.0, 0.0, -1.0, 0.03], [0.0, 0.0, 0.0, 1.0]],
        "timeshift_cam_imu": -0.0021,
    },
    "imu0": {
        "update_rate": 200.0,
        "accelerometer_noise_density": 2e-3,
        "accelerometer_random_walk": 3e-4,
        "gyroscope_noise_density": 2.4e-4,
        "gyroscope_random_walk": 2e-5,
    },
    "laser0": {"plane": [-0.026176948, 0.9414192, 0.336221143, -0.01176774], "range_m": [0.02, 0.15]},
}


def with_value(dotted: str, value: Any) -> str:
    """Return the text of the good document with one key set, or removed where ``value`` is ``...``."""
    document = copy.deepcopy(DOCUMENT)
    *path, key = dotted.split(".")
    place = document
    for name in path:
        place = place[name]
    if value is ...:
        del place[key]
    else:
        place[key] = value
    return yaml.safe_dump(document)


def problems_of(text: str, mode: Mode = Mode.VLI_SLAM) -> tuple[str, ...]:
    with pytest.raises(CalibrationError) as caught:
        parse_calibration(text, mode)
    return caught.value.problems


def test_a_valid_file_is_read_in_full() -> None:
    calibration = parse_calibration(yaml.safe_dump(DOCUMENT))
    assert calibration.camera.fx == 362.4
    assert (calibration.camera.width, calibration.camera.height) == (640, 480)
    assert calibration.timeshift_ns == -2_100_000
    assert calibration.imu is not None
    assert calibration.imu.gyroscope_random_walk == 2e-5
    assert calibration.T_cam_imu is not None
    np.testing.assert_allclose(calibration.T_cam_imu[:3, 3], [0.01, 0.02, 0.03])


def test_the_plane_is_read_with_either_sign_and_held_and_written_with_positive_d() -> None:
    first = parse_calibration(yaml.safe_dump(DOCUMENT)).laser
    second = parse_calibration(with_value("laser0.plane", [-value for value in DOCUMENT["laser0"]["plane"]])).laser
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.normal, second.normal)
    assert first.d == second.d > 0
    assert yaml.safe_load(to_yaml(DOCUMENT))["laser0"]["plane"][3] > 0


def test_the_rotation_is_made_orthonormal_to_machine_precision() -> None:
    rows = copy.deepcopy(DOCUMENT["cam0"]["T_cam_imu"])
    rows[0][1] = 1.0004
    T = parse_calibration(with_value("cam0.T_cam_imu", rows)).T_cam_imu
    assert T is not None
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-15)


def test_writing_and_reading_gives_the_same_calibration_and_keeps_every_key() -> None:
    document = copy.deepcopy(DOCUMENT)
    document["cam0"]["provenance"] = {"date": "2026-01-05", "images": 14, "residuals": {"rms_px": np.float64(0.228)}}
    document["cam0"]["intrinsics"] = np.array(document["cam0"]["intrinsics"])
    text = to_yaml(document)
    again = parse_calibration(text)
    assert to_yaml(again.document) == text
    assert again.document["cam0"]["provenance"]["residuals"] == {"rms_px": 0.228}
    assert "intrinsics: [362.4, 363.1, 323.7, 236.9]" in text


KALIBR_CAMCHAIN = """
cam0:
  T_cam_imu:
  - [0.0, 1.0, 0.0, 0.01]
  - [1.0, 0.0, 0.0, 0.02]
  - [0.0, 0.0, -1.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [0.012, -0.008, 0.003, -0.001]
  distortion_model: equidistant
  intrinsics: [362.4, 363.1, 323.7, 236.9]
  resolution: [640, 480]
  rostopic: /camera/image_raw
  timeshift_cam_imu: 0.0021
"""
KALIBR_IMU = """
imu0:
  T_i_b:
  - [1.0, 0.0, 0.0, 0.0]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  accelerometer_noise_density: 2e-3
  accelerometer_random_walk: 0.0003
  gyroscope_noise_density: 0.00024
  gyroscope_random_walk: 2.0e-05
  model: calibrated
  rostopic: /imu
  time_offset: 0.0
  update_rate: 200.0
"""
KALIBR_IMU_INPUT = "\n".join(
    line.strip() for line in KALIBR_IMU.splitlines() if ":" in line and "imu0" not in line and "T_i_b" not in line
)


@pytest.mark.parametrize("imu", [KALIBR_IMU, KALIBR_IMU_INPUT], ids=["written by Kalibr", "read by Kalibr"])
def test_what_kalibr_writes_drops_in_and_is_kept(imu: str) -> None:
    calibration = parse_calibration(KALIBR_CAMCHAIN, Mode.VI, imu_text=imu)
    assert calibration.rate_hz == 60.0
    assert calibration.imu is not None
    assert calibration.imu.accelerometer_noise_density == 2e-3, "YAML 1.1 takes 2e-3 for a string"
    assert calibration.document["cam0"]["cam_overlaps"] == []
    assert calibration.document["imu0"]["model"] == "calibrated"


NEEDED = {
    Mode.VLI_SLAM: {"cam0", "imu0", "laser0", "cam0.T_cam_imu"},
    Mode.VLI_ODOM: {"cam0", "imu0", "laser0", "cam0.T_cam_imu"},
    Mode.VI: {"cam0", "imu0", "cam0.T_cam_imu"},
    Mode.VL: {"cam0", "laser0"},
}


@pytest.mark.parametrize("mode", Mode)
@pytest.mark.parametrize("part", ["cam0", "imu0", "laser0", "cam0.T_cam_imu"])
def test_each_mode_needs_its_sections_and_no_others(mode: Mode, part: str) -> None:
    text = with_value(part, ...)
    if part not in NEEDED[mode]:
        parse_calibration(text, mode)
        return
    (problem,) = problems_of(text, mode)
    assert f"'{part}' is missing" in problem
    assert "make it with 'vli calibrate" in problem


@pytest.mark.parametrize(
    ("dotted", "value", "message"),
    [
        ("cam0.intrinsics", ..., "'cam0.intrinsics' is missing"),
        ("cam0.intrinsics", [362.4, 363.1, 323.7], "expected a list of 4 numbers"),
        ("cam0.intrinsics", [362.4, float("nan"), 323.7, 236.9], "'cam0.intrinsics' has 'nan', expected finite numbers"),
        ("cam0.intrinsics", [362.4, True, 323.7, 236.9], "'cam0.intrinsics' has 'True', expected finite numbers"),
        ("cam0.intrinsics", [-362.4, 363.1, 323.7, 236.9], "has focal lengths '-362.4, 363.1', expected positive"),
        ("cam0.intrinsics", [362.4, 363.1, 640.0, 236.9], "principal point '640.0, 236.9', expected inside the image of 640×480"),
        ("cam0.distortion_coeffs", [0.1, 0.2], "expected a list of 4 or 5 numbers"),
        ("cam0.distortion_coeffs", [float("inf"), 0, 0, 0], "has 'inf'"),
        ("cam0.distortion_coeffs", [-2.0, 0.0, 0.0, 0.0], "folds the image over itself"),
        ("cam0.distortion_model", "fov", "'fov', expected radtan or equidistant or none"),
        ("cam0.distortion_model", ["radtan"], "expected radtan or equidistant or none"),
        ("cam0.camera_model", "omni", "'omni', expected pinhole"),
        ("cam0.resolution", [640, 0], "expected whole pixels"),
        ("cam0.resolution", [640.5, 480], "expected whole pixels"),
        ("cam0.resolution", [10**9, 480], "expected whole pixels"),
        ("cam0.rate_hz", 0, "'cam0.rate_hz' is '0', expected 0.1 to 10000 Hz"),
        ("cam0.timeshift_cam_imu", "soon", "'cam0.timeshift_cam_imu' is 'soon', expected -10 to 10 s"),
        ("cam0.T_cam_imu", [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "expected 4 rows of 4 finite numbers"),
        ("cam0.T_cam_imu", np.diag([1.0, 1, 1.1, 1]).tolist(), "has no rotation (determinant '1.1'"),
        ("cam0.T_cam_imu", np.diag([1.0, 1, -1, 1]).tolist(), "has no rotation (determinant '-1'"),
        ("cam0.T_cam_imu", np.diag([1.0, 1, 1, 2]).tolist(), "expected [0, 0, 0, 1]"),
        ("cam0.intrinsic", [1], "unknown key 'cam0.intrinsic', did you mean 'intrinsics'?"),
        ("imu0.gyro_noise_density", 1.0, "unknown key 'imu0.gyro_noise_density', did you mean 'gyroscope_noise_density'?"),
        (
            "imu0.gyroscope_noise_density",
            0.0,
            "'imu0.gyroscope_noise_density' is '0.0', expected 1e-12 to 1000 in SI units per √Hz",
        ),
        ("imu0.update_rate", -200, "'imu0.update_rate' is '-200', expected 1 to 100000 Hz"),
        ("cam0.timeshift_cam_imu", 1e300, "is '1e+300', expected -10 to 10 s"),
        ("cam0.rate_hz", 1e-300, "is '1e-300', expected 0.1 to 10000 Hz"),
        ("cam0.intrinsics", [1e-300, 1e-300, 323.7, 236.9], "expected positive pixels: 1 to 1e+06 px"),
        ("cam0.T_cam_imu", np.diag([1e200, 1e200, 1e200, 1]).tolist(), "has no rotation"),
        ("imu0.accelerometer_noise_density", 1e300, "is '1e+300', expected 1e-12 to 1000 in SI units per √Hz"),
        ("laser0.range_m", [1e-300, 1e300], "expected [near, far] with near < far, 0.0001 to 100 m"),
        ("imu0", [1, 2], "section 'imu0' is '[1, 2]', expected keys update_rate"),
        ("laser", {}, "unknown section 'laser', did you mean 'laser0'?"),
        ("cam1", {}, "two cameras ('cam0, cam1'), expected one"),
        ("laser0.plane", [0, 0, 0, 0.1], "laser plane normal has norm '0.0', expected 1; re-run 'vli calibrate laser'"),
        ("laser0.plane", [0, 3, 4, 0.1], "laser plane normal has norm '5.0', expected 1; re-run 'vli calibrate laser'"),
        ("laser0.plane", [0, -0.8, 0.6, 0.0], "passes through the camera's centre"),
        ("laser0.plane", [0, 0, 1.0, 0.05], "lies behind the camera"),
        ("laser0.plane", [0, 0, -1.0, 1.5], "does not meet the view between 0.02 and 0.15 m"),
        ("laser0.plane", [0, 1, 0], "expected a list of 4 numbers"),
        ("laser0.range_m", [0.15, 0.02], "expected [near, far] with near < far, 0.0001 to 100 m"),
        ("laser0.range_m", [0.0, 0.02], "expected [near, far] with near < far, 0.0001 to 100 m"),
    ],
)
def test_a_wrong_value_is_named_with_what_would_be_valid(dotted: str, value: Any, message: str) -> None:
    (problem,) = problems_of(with_value(dotted, value))
    assert message in problem


def test_all_problems_are_listed_at_once() -> None:
    document = copy.deepcopy(DOCUMENT)
    document["cam0"].update(intrinsics=[1, 2], rate_hz=-1, unheard_of=1)
    document["imu0"]["update_rate"] = float("nan")
    document["laser0"].update(plane=[0, 0, 0, 0.1], range_m=[2, 1])
    problems = problems_of(yaml.safe_dump(document))
    assert len(problems) == 6
    message = str(CalibrationError("lab.yaml", problems))
    assert message.startswith("calibration 'lab.yaml': ")
    assert "\n" not in message


@pytest.mark.parametrize("coefficients", [None, [], [0.0, 0.0, 0.0, 0.0]])
def test_a_lens_without_distortion_needs_no_coefficients(coefficients: list[float] | None) -> None:
    document = copy.deepcopy(DOCUMENT)
    document["cam0"].update(distortion_model="none", distortion_coeffs=coefficients)
    camera = parse_calibration(yaml.safe_dump(document)).camera
    np.testing.assert_allclose(camera.project(np.array([[0.01, 0.02, 0.1]])), [[323.7 + 36.24, 236.9 + 72.62]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such file; make one with 'vli calibrate camera DIR --target T --out"),
        (b"", "holds 'nothing', expected sections cam0, imu0, laser0"),
        (b"- 1\n- 2\n", "holds 'list', expected sections"),
        (b"cam0: [1, 2", "not YAML at line 1"),
        (b"[" * 100_000, "not YAML"),
        (b"\xff\xfe\x00", "cannot be read"),
        (b"d: 2026-99-99", "not YAML"),
    ],
)
def test_a_file_that_is_missing_or_no_calibration_gives_one_line_with_the_next_command(
    tmp_path: Path, content: bytes | None, message: str
) -> None:
    path = tmp_path / "calibration.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CalibrationError, match=r"^calibration '.*calibration\.yaml': ") as caught:
        load_calibration(path)
    assert message in str(caught.value)
    assert len(caught.value.problems) == 1


def test_a_directory_in_place_of_the_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="cannot be read"):
        load_calibration(tmp_path)


def test_the_calibration_of_the_recording_is_valid(shared_data: Path) -> None:
    calibration = load_calibration(shared_data / "keyboard_short" / "calibration.yaml")
    assert calibration.laser is not None
    assert calibration.laser.d == pytest.approx(0.01176774)


scalars = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
values = st.recursive(
    scalars, lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=4), inner, max_size=3), max_leaves=20
)


@settings(max_examples=300, deadline=None)
@given(st.sampled_from([f"{name}.{key}" for name, section in DOCUMENT.items() for key in section] + list(DOCUMENT)), values)
def test_whatever_stands_in_the_file_there_is_a_calibration_or_a_calibration_error(dotted: str, value: Any) -> None:
    document = copy.deepcopy(DOCUMENT)
    name, _, key = dotted.partition(".")
    (document[name] if key else document).update({key or name: value})
    for mode in Mode:
        try:
            calibration = parse_calibration(yaml.safe_dump(document, allow_unicode=True), mode)
        except CalibrationError:
            continue
        assert np.isfinite(calibration.camera.unproject(np.array([[0.0, 0.0], [639.0, 479.0]]))).all()


def test_the_example_in_config_is_the_scanner_of_the_demo_bag(repository: Path) -> None:
    example = load_calibration(repository / "config" / "calibration" / "example.yaml")
    demo = load_calibration(repository / "bags" / "demo" / "calibration.yaml")
    assert example.camera == demo.camera
    assert example.imu == demo.imu
    np.testing.assert_array_equal(example.T_cam_imu, demo.T_cam_imu)
    assert example.laser is not None
    assert demo.laser is not None
    np.testing.assert_array_equal([*example.laser.normal, example.laser.d], [*demo.laser.normal, demo.laser.d])


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n" for before, name in itertools.pairwise("abcdefghi")
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (BOMB + "cam0: *i\n", "more than '50000' values"),
        ("cam0: &a [*a]\n", "more than '50000' values"),
        (
            BOMB.replace("[x, x, x, x, x, x, x, x, x]", "{x: 1}").replace("[", "{<<: [").replace("]", "]}"),
            "more than '50000' values",
        ),
        ("x" * 300_000, "has '300000' characters, expected at most"),
        ("[" * 5_000, "is not YAML"),
        ("cam0: !!python/object/apply:os.system [id]\n", "is not YAML at line 1"),
        ("cam0: 1" + "0" * 5000 + "\n", "holds an integer of '5001' digits, expected at most 64"),
        ("? 0x" + "f" * 5000 + "\n: 1\n", "holds an integer of '5002' digits, expected at most 64"),
        ("cam0: 2001-99-99\n", "is not YAML: ValueError"),
    ],
    ids=["aliases", "a loop", "merge keys", "too long", "too deep", "code", "a number of 5000 digits", "and a name", "no date"],
)
def test_a_hostile_document_is_refused_at_once_and_in_a_short_line(text: str, said: str) -> None:
    with pytest.raises(CalibrationError) as error:
        parse_calibration(text)
    assert said in str(error.value)
    assert len(str(error.value)) < 500


def test_an_alias_as_kalibr_may_write_is_no_bomb() -> None:
    document = copy.deepcopy(DOCUMENT)
    document["cam0"]["T_cn_cnm1"] = document["cam0"]["T_cam_imu"]
    text = yaml.safe_dump(document)
    assert "*id001" in text
    assert parse_calibration(text).document == document


def test_many_strange_names_are_told_in_a_few_lines() -> None:
    document = {**copy.deepcopy(DOCUMENT), **{f"section {number}": {} for number in range(2000)}}
    problems = problems_of(yaml.safe_dump(document))
    assert len(problems) == 11
    assert problems[-1] == "and '1990' more unknown names"
