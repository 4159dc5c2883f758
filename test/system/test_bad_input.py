"""Bad input to the commands: one line that says what to do, exit code 2, and nothing left behind."""

from __future__ import annotations

import math
import re

import pytest
from tiny_bag import TinyBag, write_calibration

from vli_bringup.cli import main


@pytest.fixture(scope="session")
def good_bag(tmp_path_factory):
    return TinyBag().write(tmp_path_factory.mktemp("bags") / "good")


@pytest.fixture
def calibration(tmp_path):
    return write_calibration(tmp_path / "calibration.yaml")


@pytest.fixture
def refused(tmp_path, capsys):
    """Return a function that runs the command, expects a refusal and returns its line."""

    def run(bag, calibration, *options):
        before = set(tmp_path.iterdir())
        assert main(["run", str(bag), "--calib", str(calibration), "--out", str(tmp_path / "out"), *options]) == 2
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.count("\n") == 1
        assert set(tmp_path.iterdir()) == before
        return captured.err

    return run


def test_no_bag(refused, calibration, tmp_path):
    assert f"bag '{tmp_path / 'none'}' does not exist; expected a rosbag2 directory" in refused(tmp_path / "none", calibration)


def test_a_directory_without_a_bag(refused, calibration, tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").touch()
    assert "holds no .mcap or .db3 file (it holds cat.jpg)" in refused(tmp_path / "photos", calibration)


def test_an_empty_file(refused, calibration, tmp_path):
    (tmp_path / "empty.mcap").touch()
    assert "empty.mcap" in refused(tmp_path / "empty.mcap", calibration)


def test_a_bag_without_the_topics_lists_what_is_there(refused, calibration, tmp_path):
    bag = TinyBag(image_topics=(), imu_topics=(), others={"/chatter": "hello"}).write(tmp_path / "bag")
    line = refused(bag, calibration)
    assert "no image topic '/camera/image_raw'" in line
    assert "/chatter (std_msgs/msg/String)" in line
    assert "--topic image=/name" in line


def test_a_bag_without_an_imu_names_the_option(refused, calibration, tmp_path):
    bag = TinyBag(imu_topics=()).write(tmp_path / "bag")
    line = refused(bag, calibration)
    assert "has no imu topic '/imu'" in line
    assert "choose one with --topic imu=/name or run without it: --mode vl" in line


def test_two_cameras_say_which_to_pick(refused, calibration, tmp_path):
    bag = TinyBag(image_topics=("/left/image_raw", "/right/image_raw")).write(tmp_path / "bag")
    line = refused(bag, calibration)
    assert "has 2 image topics (/left/image_raw, /right/image_raw)" in line
    assert "--topic image=/left/image_raw" in line


def test_stamps_all_zero(refused, calibration, tmp_path):
    bag = TinyBag(image_stamp=lambda stamp: 0).write(tmp_path / "bag")
    assert "stamped '0'; expected the time of mid-exposure in header.stamp" in refused(bag, calibration)


def test_images_of_another_size(refused, calibration, tmp_path):
    bag = TinyBag(size=(320, 240)).write(tmp_path / "bag")
    line = refused(bag, calibration)
    assert "images on '/camera/image_raw/compressed' are '320 x 240', the calibration is for 160 x 120" in line


def test_an_imu_on_another_clock(refused, calibration, tmp_path):
    bag = TinyBag(imu_stamp=lambda stamp: stamp - 1_600_000_000_000_000_000).write(tmp_path / "bag")
    line = refused(bag, calibration)
    assert "no IMU sample on '/imu' lies between the images" in line
    assert "stamp both by one clock, or run without the IMU: --mode vl" in line


def test_an_imu_in_g(refused, calibration, tmp_path):
    bag = TinyBag(accel=(0.0, 0.0, 1.0)).write(tmp_path / "bag")
    assert "that is g, multiply linear_acceleration by 9.80665" in refused(bag, calibration)


def test_a_gyro_in_degrees(refused, calibration, tmp_path):
    bag = TinyBag(tilt_rate=0.3, gyro_unit=math.degrees(1), seconds=6.0).write(tmp_path / "bag")
    assert "that is deg/s, convert angular_velocity to rad/s" in refused(bag, calibration)


def test_no_calibration(refused, good_bag, tmp_path):
    line = refused(good_bag, tmp_path / "none.yaml")
    assert f"calibration '{tmp_path / 'none.yaml'}': no such file" in line
    assert "vli calibrate camera" in line


def set_plane(*plane):
    return lambda document: document["laser0"].update(plane=list(plane))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (set_plane(0.0, 1.6, -1.2, 0.02), "norm"),
        (set_plane(0.0, 0.8, -0.6, math.nan), "nan"),
        (set_plane(0.0, 0.0, 1.0, 0.02), "behind"),
        (lambda document: document.pop("laser0"), "laser0"),
        (lambda document: document["cam0"].update(intrinsics=[120.0, 120.0, 79.5]), "intrinsics"),
        (lambda document: document["cam0"].update(fx=120.0), "fx"),
    ],
    ids=["non-unit normal", "NaN", "plane behind the camera", "no laser", "three intrinsics", "unknown key"],
)
def test_an_invalid_calibration(refused, good_bag, tmp_path, change, said):
    line = refused(good_bag, write_calibration(tmp_path / "calibration.yaml", change))
    assert said in line
    assert str(tmp_path / "calibration.yaml") in line


def test_every_problem_of_a_calibration_is_said_at_once(refused, good_bag, tmp_path):
    def change(document):
        document["laser0"]["plane"] = [0.0, 1.6, -1.2, 0.02]
        document["imu0"]["update_rate"] = -1.0

    line = refused(good_bag, write_calibration(tmp_path / "calibration.yaml", change))
    assert "norm" in line
    assert "update_rate" in line


def test_a_calibration_that_is_not_yaml(refused, good_bag, tmp_path):
    (tmp_path / "calibration.yaml").write_text("cam0: [")
    assert "not YAML" in refused(good_bag, tmp_path / "calibration.yaml")


def test_unknown_and_impossible_parameters_are_said_at_once(refused, good_bag, calibration):
    line = refused(good_bag, calibration, "--set", "backend.window_keyframe=9", "--set", "demux.min_ratio=-1")
    assert "unknown parameter 'backend.window_keyframe', did you mean 'backend.window_keyframes'?" in line
    assert "'demux.min_ratio' is '-1.0'" in line


def test_a_topic_that_is_not_there(refused, good_bag, calibration):
    assert "no image topic '/front/image'" in refused(good_bag, calibration, "--topic", "image=/front/image")


def test_a_part_that_lies_beyond_the_end(refused, good_bag, calibration):
    line = refused(good_bag, calibration, "--start", "1e9")
    assert "that is asked for holds no image, the bag has '2.0' s; choose another with --start and --duration" in line


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--start", "soon", "'soon', expected seconds, 0 or more"),
        ("--start", "-1", "'-1', expected seconds, 0 or more"),
        ("--duration", "0", "'0', expected seconds, more than 0"),
        ("--duration", "-1", "'-1', expected seconds, more than 0"),
        ("--topic", "imu", "'imu', expected one of image=/name, imu=/name"),
        ("--speed", "2", "unrecognized arguments: --speed 2"),
    ],
)
def test_a_value_that_an_option_cannot_have(good_bag, calibration, tmp_path, capsys, option, value, said):
    with pytest.raises(SystemExit) as error:
        main(["run", str(good_bag), "--calib", str(calibration), "--out", str(tmp_path / "out"), option, value])
    line = capsys.readouterr().err
    assert error.value.code == 2
    assert line.count("\n") == 1
    assert said in line
    assert line.endswith("see 'vli run --help'\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["scan ü 扫描", "a/b c/d"])
def test_any_name_will_do(good_bag, tmp_path, capsys, name):
    place = tmp_path / name
    place.mkdir(parents=True)
    bag = place / "bäg"
    bag.symlink_to(good_bag)
    calibration = write_calibration(place / "cal ib.yaml")
    out = place / "new" / "out put"
    assert main(["run", str(bag), "--calib", str(calibration), "--out", str(out), "--duration", "0.3"]) == 1
    assert capsys.readouterr().err.startswith("vli run: tracking never started in ")
    assert (out / "summary.json").exists()


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (("run", "BAG", "--calib", "CALIB", "--out", "."), "'.' is no name for a new directory"),
        (("run", "BAG", "--calib", "CALIB", "--out", "file/out"), "'file/out.partial' cannot be made (Not a directory)"),
        (("simulate", "keyboard", "--out", "thesis"), "'thesis' is not empty"),
        (("simulate", "keyboard", "--out", "thesis", "--overwrite"), "'thesis' holds 'thesis.tex' but no 'simulation.yaml'"),
        (("simulate", "board", "--out", "thesis", "--overwrite"), "'thesis' holds 'thesis.tex' but no 'simulation.yaml'"),
        (("simulate", "keyboard", "--out", "file", "--overwrite"), "'file' is a file, expected a directory"),
        (("export", "thesis", "--out", "absent/map.ply"), "there is no directory 'absent'; make it first"),
        (("export", "thesis", "--out", "map.ply"), "'thesis/map.vli' cannot be read"),
        (("merge", "file", "file", "--out", "absent/map.vli"), "there is no directory 'absent'; make it first"),
        (("doctor", "--live", "--start", "3"), "--start is '3', which is of a bag"),
        (("doctor", "BAG", "--start", "99"), "holds no image, the bag has '2.0' s"),
        (("eval", "thesis", "--truth", "file"), "'thesis' holds no 'trajectory.tum'"),
    ],
)
def test_a_place_that_cannot_be_used_is_left_as_it_is(good_bag, tmp_path, capsys, monkeypatch, command, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("precious")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "thesis.tex").write_text("precious")
    write_calibration(tmp_path / "calibration.yaml")
    before = {path: path.is_file() and path.read_text() for path in tmp_path.rglob("*")}
    arguments = [{"BAG": str(good_bag), "CALIB": "calibration.yaml"}.get(word, word) for word in command]
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert (captured.out, captured.err.count("\n")) == ("", 1)
    assert said in captured.err
    assert {path: path.is_file() and path.read_text() for path in tmp_path.rglob("*")} == before


def test_an_output_that_holds_something(good_bag, calibration, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").touch()
    assert main(["run", str(good_bag), "--calib", str(calibration), "--out", str(tmp_path / "out")]) == 2
    assert "is not empty; choose another with --out DIR" in capsys.readouterr().err
    assert [item.name for item in (tmp_path / "out").iterdir()] == ["thesis.tex"]


def test_a_scan_that_never_starts_says_why_and_exits_with_1(calibration, tmp_path, capsys):
    bag = TinyBag(seconds=0.3).write(tmp_path / "bag")
    assert main(["run", str(bag), "--calib", str(calibration), "--out", str(tmp_path / "out")]) == 1
    assert re.search(r"tracking never started in 9 long frames: \w+", capsys.readouterr().err)
    assert (tmp_path / "out" / "trajectory.tum").read_text() == ""


def test_half_a_bag_is_run_with_a_warning_of_what_was_lost(good_bag, calibration, tmp_path, capsys):
    whole = next(good_bag.glob("*.mcap")).read_bytes()
    half = tmp_path / "half.mcap"
    half.write_bytes(whole[: len(whole) // 2])
    assert main(["run", str(half), "--calib", str(calibration), "--out", str(tmp_path / "out")]) in (0, 1)
    lines = capsys.readouterr().err.splitlines()
    assert sum("warning" in line and "half.mcap" in line for line in lines) == 1
    assert (tmp_path / "out" / "summary.json").exists()


def test_images_that_are_none_are_left_out_and_counted(calibration, tmp_path, capsys):
    bag = TinyBag(broken_images=0.1).write(tmp_path / "bag")
    assert main(["run", str(bag), "--calib", str(calibration), "--out", str(tmp_path / "out")]) in (0, 1)
    assert "warning: 12 undecodable images were left out" in capsys.readouterr().err


def test_a_first_image_that_is_none_does_not_speak_against_the_others(calibration, tmp_path, capsys):
    bag = TinyBag(broken_first=3, seconds=0.5).write(tmp_path / "bag")
    assert main(["run", str(bag), "--calib", str(calibration), "--out", str(tmp_path / "out")]) == 1
    assert "warning: 3 undecodable images were left out" in capsys.readouterr().err


def test_a_bag_whose_images_are_none_is_refused(refused, calibration, tmp_path):
    bag = TinyBag(broken_first=60, seconds=0.5).write(tmp_path / "bag")
    assert "compressed image of format 'jpeg' starts with '00000000', expected a jpeg or a png" in refused(bag, calibration)
