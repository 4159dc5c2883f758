"""F24: bags that are cut, rotten, empty, of other topics, or of the older storage."""

from __future__ import annotations

import re
import shutil

import numpy as np
import pytest
from bags import IMAGES, IMU, write_bag, write_chunked
from rosbags.rosbag2 import StoragePlugin
from streams import images, samples, until
from tiny_bag import TinyBag, write_calibration

from vli_bringup.cli import main
from vli_driver.bag import BagReader


@pytest.fixture(scope="module")
def good(recording, tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("faults") / "good", until(recording, 2.0))


@pytest.fixture
def command(demo, tmp_path, capsys):
    """Return a function that runs a bag and returns the exit code and the lines on stderr."""

    def command(bag, *options):
        calibration = demo / "calibration.yaml"
        code = main(["run", str(bag), "--calib", str(calibration), "--out", str(tmp_path / "out"), *options])
        return code, capsys.readouterr().err.splitlines()

    return command


def truncated(bag, tmp_path, share):
    whole = next(bag.glob("*.mcap")).read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[: int(share * len(whole))])
    return path


@pytest.mark.parametrize("share", [0.9, 0.6])
def test_f24_a_truncated_bag_is_read_as_far_as_it_goes_and_says_how_far(good, command, tmp_path, share):
    code, lines = command(truncated(good, tmp_path, share))
    assert code == 0
    told = [line for line in lines if "is truncated" in line]
    assert len(told) == 1
    count = int(re.search(r"(\d+) whole messages of [\d.]+ s were read, what followed is lost", told[0])[1])
    assert 0.4 * share * 520 < count < 520


def test_f24_rotten_bits_cost_their_chunk_and_no_more(recording, command, tmp_path):
    stream = until(recording, 2.0)
    path = write_chunked(tmp_path / "rotten.mcap", stream)
    data = bytearray(path.read_bytes())
    for index in np.random.default_rng(24).integers(len(data) // 2, len(data) // 2 + 1000, 20):
        data[index] ^= 0x55
    path.write_bytes(data)
    code, lines = command(path)
    assert code == 0
    lost = [float(found[1]) for line in lines if (found := re.search(r"a chunk of ([\d.]+) s at byte \d+ was lost", line))]
    assert len(lost) == 1
    left = [item.stamp_ns for item in BagReader(path)]
    assert len(left) == pytest.approx(len(stream) - lost[0] / 0.004, abs=2)
    assert set(left) < {item.stamp_ns for item in stream}


def test_f24_metadata_are_not_needed(good, command, tmp_path):
    bag = tmp_path / "bag"
    shutil.copytree(good, bag)
    (bag / "metadata.yaml").unlink()
    code, lines = command(bag)
    assert (code, lines) == (0, [])


def test_f24_the_older_storage_serves_as_well(recording, command, tmp_path):
    bag = write_bag(tmp_path / "bag", until(recording, 2.0), StoragePlugin.SQLITE3)
    assert next(bag.glob("*.db3"))
    code, lines = command(bag)
    assert (code, lines) == (0, [])


def test_f24_a_damaged_database_is_told_in_a_line(recording, command, tmp_path):
    bag = write_bag(tmp_path / "bag", until(recording, 2.0), StoragePlugin.SQLITE3)
    path = next(bag.glob("*.db3"))
    data = bytearray(path.read_bytes())
    data[len(data) // 3 :] = b"\x5a" * (len(data) - len(data) // 3)
    path.write_bytes(data)
    code, lines = command(bag)
    assert code in (0, 1, 2)
    assert any("damaged" in line or "no rosbag2 database" in line for line in lines)
    assert not any("Traceback" in line for line in lines)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda bag: next(bag.glob("*.mcap")).write_bytes(b""), "is empty; expected an mcap file, record again"),
        (lambda bag: next(bag.glob("*.mcap")).write_bytes(b"PK\x03\x04" + bytes(100)), "is no mcap file: it starts with"),
        (lambda bag: next(bag.glob("*.mcap")).unlink(), "holds no .mcap or .db3 file"),
        (shutil.rmtree, "does not exist; expected a rosbag2 directory or an .mcap file"),
    ],
    ids=["empty", "a zip", "only metadata", "nothing"],
)
def test_f24_what_is_no_bag_is_refused_in_a_line(good, command, tmp_path, spoil, said):
    bag = tmp_path / "bag"
    shutil.copytree(good, bag)
    spoil(bag)
    code, lines = command(bag)
    assert code == 2
    assert len(lines) == 1
    assert said in lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("topics", "said"),
    [
        ({"image_topics": ()}, "has no image topic '/camera/image_raw'; it has /imu (sensor_msgs/msg/Imu)"),
        ({"imu_topics": ()}, "has no imu topic '/imu'"),
        ({"image_topics": ("/left", "/right")}, "has 2 image topics (/left, /right); choose one with --topic image=/left"),
        ({"imu_topics": ("/a", "/b")}, "has 2 IMU topics (/a, /b); choose one with --topic imu=/a"),
    ],
    ids=["no image", "no IMU", "two cameras", "two IMUs"],
)
def test_f24_other_topics_are_listed(tmp_path, capsys, topics, said):
    bag = TinyBag(seconds=0.3, **topics).write(tmp_path / "bag")
    calibration = write_calibration(tmp_path / "calibration.yaml")
    assert main(["run", str(bag), "--calib", str(calibration), "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err


def test_the_bags_of_these_tests_hold_what_the_stream_holds(recording, good):
    stream = until(recording, 2.0)
    reader = BagReader(good)
    assert reader.count(IMAGES) == len(images(stream))
    assert reader.count(IMU) == len(samples(stream))
    assert [item.stamp_ns for item in reader] == [item.stamp_ns for item in stream]
