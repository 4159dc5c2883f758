"""Every kind of bag, whole and broken."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import numpy as np
import pytest
import recordings as rec
from mcap.writer import CompressionType
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from vli_common.errors import InputError
from vli_common.types import EncodedImage, ImuSample
from vli_driver.bag import BagReader, BagTopics


def stamps(reader: BagReader) -> list[int]:
    return [item.stamp_ns for item in reader]


def expected() -> list[int]:
    return [log_ns for log_ns, _, _ in rec.standard()]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"chunk_size": 20_000},
        {"chunk_size": 20_000, "compression": CompressionType.LZ4},
        {"chunk_size": 20_000, "compression": CompressionType.NONE},
        {"use_chunking": False},
        {"use_statistics": False, "use_summary_offsets": False, "repeat_channels": False, "repeat_schemas": False},
    ],
    ids=["one chunk", "chunks", "lz4", "plain", "unchunked", "no summary"],
)
def test_a_bare_mcap_yields_everything_in_log_order(tmp_path: Path, options: dict[str, object]) -> None:
    reader = BagReader(rec.write_mcap(tmp_path / "a.mcap", rec.standard(), **options))
    assert stamps(reader) == expected()
    assert reader.count("/imu") == rec.IMU_SAMPLES
    assert reader.count("/camera/image_raw") == rec.IMAGES
    assert reader.time_range_ns == (expected()[0], expected()[-1])
    assert reader.warnings == []


def test_messages_stored_out_of_order_come_out_in_order(tmp_path: Path) -> None:
    messages = list(rec.standard())
    random.Random(1).shuffle(messages)
    assert stamps(BagReader(rec.write_mcap(tmp_path / "a.mcap", messages, chunk_size=20_000))) == expected()


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_a_rosbag2_directory_needs_no_metadata(tmp_path: Path, plugin: StoragePlugin) -> None:
    rec.write(tmp_path / "bag", rec.standard(), plugin)
    assert stamps(BagReader(tmp_path / "bag")) == expected()
    (tmp_path / "bag/metadata.yaml").unlink()
    assert stamps(BagReader(tmp_path / "bag")) == expected()


def test_the_files_of_a_split_bag_are_read_as_one(tmp_path: Path) -> None:
    messages = list(rec.standard())
    (tmp_path / "bag").mkdir()
    # Names that do not sort by time.
    rec.write_mcap(tmp_path / "bag/a_10.mcap", messages[100:])
    rec.write_mcap(tmp_path / "bag/a_9.mcap", messages[:100])
    reader = BagReader(tmp_path / "bag")
    assert stamps(reader) == expected()
    assert reader.count("/imu") == rec.IMU_SAMPLES


def test_images_and_samples_hold_what_was_written(tmp_path: Path) -> None:
    items = list(BagReader(rec.write_mcap(tmp_path / "a.mcap", rec.standard())))
    image = next(item for item in items if isinstance(item, EncodedImage))
    sample = next(item for item in items if isinstance(item, ImuSample))
    assert (image.width, image.height, image.step, image.encoding, image.compressed) == (64, 48, 64, "mono8", False)
    assert image.data == rec.PIXELS.tobytes()
    np.testing.assert_allclose(sample.gyro, [0.1, 0.2, sample.stamp_ns * 1e-9])
    np.testing.assert_allclose(sample.accel, [1.0, 2.0, 9.8])


def test_start_and_duration_count_from_the_first_header_stamp(tmp_path: Path) -> None:
    # The recorder's clock is an hour ahead of the camera's.
    messages = [(log_ns + 3_600_000_000_000, topic, message) for log_ns, topic, message in rec.standard()]
    path = rec.write_mcap(tmp_path / "a.mcap", messages, chunk_size=20_000)
    assert stamps(BagReader(path, start_s=0.25, duration_s=0.5)) == [
        stamp for stamp in expected() if rec.START_NS + 250_000_000 <= stamp < rec.START_NS + 750_000_000
    ]


def test_the_exposure_topic_is_folded_into_the_images_whichever_is_logged_first(tmp_path: Path) -> None:
    messages = list(rec.standard())
    for k in range(rec.IMAGES - 1):  # the last image never gets its note
        stamp = rec.START_NS + k * rec.IMAGE_NS
        messages.append(
            (stamp + (3_000_000 if k % 3 else -3_000_000), "/camera/exposure", rec.exposure(stamp, "on" if k % 2 else "off"))
        )
    messages.sort(key=lambda item: item[0])
    reader = BagReader(rec.write_mcap(tmp_path / "a.mcap", messages))
    items = list(reader)
    images = [item for item in items if isinstance(item, EncodedImage)]
    assert [item.stamp_ns for item in items] == expected()
    assert [image.laser_on for image in images] == [k % 2 == 1 for k in range(rec.IMAGES - 1)] + [None]
    assert images[1].exposure_s == pytest.approx(3e-4)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD])
def test_a_truncated_file_yields_what_is_whole_and_says_so(tmp_path: Path, share: float, compression: CompressionType) -> None:
    path = rec.write_mcap(tmp_path / "a.mcap", rec.standard(), chunk_size=10_000, compression=compression)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    reader = BagReader(path)
    got = stamps(reader)
    assert got == expected()[: len(got)]
    assert share - 0.15 < len(got) / len(expected()) <= 1
    assert len(reader.warnings) == 1
    assert "truncated" in reader.warnings[0]
    assert f"{len(got)} whole messages" in reader.warnings[0]


def test_of_a_cut_plain_chunk_the_whole_messages_are_saved(tmp_path: Path) -> None:
    path = rec.write_mcap(tmp_path / "a.mcap", rec.standard(), chunk_size=1 << 30, compression=CompressionType.NONE)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert 0.4 < len(stamps(BagReader(path))) / len(expected()) < 0.6


def test_a_rotten_chunk_is_left_out_and_said(tmp_path: Path) -> None:
    path = rec.write_mcap(tmp_path / "a.mcap", rec.standard(), chunk_size=20_000, compression=CompressionType.NONE)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    reader = BagReader(path)
    got = stamps(reader)
    assert 0.8 * len(expected()) < len(got) < len(expected())
    assert set(got) < set(expected())
    assert any("checksum mismatch" in warning for warning in reader.warnings)


def test_a_single_camera_and_imu_are_found_under_any_name(tmp_path: Path) -> None:
    reader = BagReader(rec.write_mcap(tmp_path / "a.mcap", rec.standard("/front/rgb", "/xsens")))
    assert (reader.image_topic, reader.imu_topic) == ("/front/rgb", "/xsens")


def test_the_compressed_stream_of_the_same_camera_is_no_second_camera(tmp_path: Path) -> None:
    extra = [(rec.START_NS, "/front/rgb/compressed", rec.compressed(rec.START_NS))]
    reader = BagReader(rec.write_mcap(tmp_path / "a.mcap", [*rec.standard("/front/rgb"), *extra]))
    assert reader.image_topic == "/front/rgb"


def test_a_compressed_stream_serves_where_there_is_no_raw_one(tmp_path: Path) -> None:
    messages = [
        (rec.START_NS, "/camera/image_raw/compressed", rec.compressed(rec.START_NS)),
        (rec.START_NS, "/imu", rec.imu(rec.START_NS)),
    ]
    reader = BagReader(rec.write_mcap(tmp_path / "a.mcap", messages))
    image = next(reader.images())
    assert image is not None
    assert (image.compressed, image.encoding, image.data[:2]) == (True, "jpeg", b"\xff\xd8")


def test_without_an_imu_a_bag_serves_where_none_is_required(tmp_path: Path) -> None:
    path = rec.write_mcap(tmp_path / "a.mcap", rec.standard(imu_topic=None))
    assert len(stamps(BagReader(path, BagTopics(imu_required=False)))) == rec.IMAGES
    with pytest.raises(InputError, match=r"no imu topic '/imu'; it has /camera/image_raw \(sensor_msgs/msg/Image\)"):
        BagReader(path)


def broken(tmp_path: Path, what: str) -> Path:
    """Make the broken input called ``what``."""
    path = tmp_path / "bag.mcap"
    match what:
        case "empty file":
            path.touch()
        case "bad magic":
            path.write_bytes(b"#ROSBAG V2.0\n" * 10)
        case "nothing after the magic":
            path.write_bytes(rec.write_mcap(path, rec.standard()).read_bytes()[:8])
        case "empty directory":
            path = tmp_path / "bag"
            path.mkdir()
        case "no bag":
            path = tmp_path / "notes.txt"
            path.write_text("hello")
        case "bad database":
            path = tmp_path / "bag.db3"
            path.write_text("hello" * 100)
        case "compressed by message":
            rec.write(tmp_path / "bag", rec.standard(), StoragePlugin.SQLITE3, CompressionMode.MESSAGE)
            path = tmp_path / "bag"
        case "compressed as a file":
            shutil.move(rec.write(tmp_path / "bag", rec.standard()), tmp_path / "bag/bag.mcap.zstd")
            path = tmp_path / "bag"
        case "two cameras":
            rec.write_mcap(path, [*rec.standard("/left"), *rec.standard("/right", None)])
        case "two IMUs":
            rec.write_mcap(path, [*rec.standard(imu_topic="/a"), (rec.START_NS, "/b", rec.imu(rec.START_NS))])
        case "wrong type":
            rec.write_mcap(path, [*rec.standard("/x"), (rec.START_NS, "/camera/image_raw", rec.imu(rec.START_NS))])
    return path


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("missing", "bag '.*bag.mcap' does not exist; expected a rosbag2 directory"),
        ("empty file", "is empty; expected an mcap file"),
        ("bad magic", "is no mcap file: it starts with '23524f53"),
        ("nothing after the magic", "no image topic '/camera/image_raw'; it has no topics at all"),
        ("empty directory", r"holds no .mcap or .db3 file \(it holds nothing\)"),
        ("no bag", "'.*notes.txt' is no bag"),
        ("bad database", "is no rosbag2 database"),
        ("compressed by message", "compressed message by message; convert it"),
        ("compressed as a file", "unpack it with: zstd -d"),
        ("two cameras", r"has 2 image topics \(/left, /right\); choose one with --topic image=/left"),
        ("two IMUs", r"has 2 IMU topics \(/a, /b\); choose one with --topic imu=/a"),
        ("wrong type", "topic '/camera/image_raw' in .* has type 'sensor_msgs/msg/Imu', expected sensor_msgs/Image"),
    ],
)
def test_broken_input_is_one_sentence_that_says_what_to_do(tmp_path: Path, what: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as raised:
        BagReader(broken(tmp_path, what))
    assert "\n" not in str(raised.value)


def test_a_name_given_by_the_user_is_not_replaced(tmp_path: Path) -> None:
    path = rec.write_mcap(tmp_path / "a.mcap", rec.standard())
    with pytest.raises(InputError, match="no image topic '/typo'; it has /camera/image_raw"):
        BagReader(path, BagTopics(image="/typo"))


def test_images_without_stamps_are_refused(tmp_path: Path) -> None:
    messages = [(rec.START_NS + k, "/camera/image_raw", rec.image(0)) for k in range(3)]
    with pytest.raises(InputError, match="stamped '0'; expected the time of mid-exposure"):
        list(BagReader(rec.write_mcap(tmp_path / "a.mcap", messages), BagTopics(imu_required=False)))


def test_the_recording_is_counted_without_being_decoded(shared_data: Path) -> None:
    reader = BagReader(shared_data / "keyboard_short/bag")
    assert (reader.count(reader.image_topic), reader.count("/imu")) == (1500, 5040)
    info = reader.camera_info()
    assert info is not None
    assert (info.width, info.height) == (640, 480)
