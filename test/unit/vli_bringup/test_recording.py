"""The file of a recording: whole, cut off, on a disk that is full, and the queue in front of it."""

from __future__ import annotations

import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rclpy.qos import qos_profile_sensor_data
from rosbags.highlevel import AnyReader

from vli_bringup.cli import main
from vli_bringup.recording.bag_writer import BagWriter
from vli_bringup.recording.directory import RecordingDirectory
from vli_bringup.recording.topic import RawMessage, RecordedTopic
from vli_bringup.recording.writer_thread import WriterThread
from vli_common.errors import OutputError
from vli_driver.bag_file import McapFile

MS = 1_000_000


def imu_topic() -> RecordedTopic:
    return RecordedTopic("/imu", "sensor_msgs/msg/Imu", 200, [qos_profile_sensor_data])


def message(number: int, size: int = 64) -> RawMessage:
    return RawMessage(number.to_bytes(size, "little"), 1_000 + number * 5 * MS, 900 + number * 5 * MS, number)


@contextmanager
def file_size_limited_to(size: int) -> Iterator[None]:
    """Let every write beyond ``size`` fail, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def numbers_in(path: Path) -> list[int]:
    return [int.from_bytes(item.data, "little") for item in McapFile(path).messages({"/imu"})]


def test_a_closed_recording_is_a_rosbag2_directory_that_other_readers_read(tmp_path: Path) -> None:
    writer, imu = BagWriter(tmp_path, "scan"), imu_topic()
    camera = RecordedTopic("/camera/image_raw/compressed", "sensor_msgs/msg/CompressedImage", 30)
    for number in range(400):
        writer.write(imu, message(number))
    writer.flush()
    writer.write(camera, message(400))
    writer.close()
    with AnyReader([tmp_path]) as reader:
        assert reader.topics["/imu"].msgcount == 400
        assert reader.duration == 2000 * MS + 1
        imu_connection = next(item for item in reader.connections if item.topic == "/imu")
        assert imu_connection.ext.offered_qos_profiles[0].reliability.name == "BEST_EFFORT"
        read = [(stamp, bytes(data)) for _, stamp, data in reader.messages([imu_connection])]
    assert read == [(message(number).log_ns, message(number).data) for number in range(400)]
    information = yaml.safe_load((tmp_path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert information["message_count"] == 401
    assert "*" not in (tmp_path / "metadata.yaml").read_text()
    with (tmp_path / "scan_0.mcap").open("rb") as stream:
        _, channel, stored = next(iter(make_reader(stream, validate_crcs=True).iter_messages()))
    assert (stored.publish_time, stored.sequence) == (message(0).publish_ns, 0)
    assert channel.metadata["topic_type_hash"].startswith("RIHS01_")


def test_chunks_are_compressed_and_have_a_checksum(tmp_path: Path) -> None:
    writer, imu = BagWriter(tmp_path, "scan"), imu_topic()
    for number in range(1000):
        writer.write(imu, message(number, 320))
    writer.close()
    with (tmp_path / "scan_0.mcap").open("rb") as stream:
        (chunk,) = [item for item in StreamReader(stream, emit_chunks=True).records if type(item).__name__ == "Chunk"]
    assert chunk.compression == "zstd"
    assert chunk.uncompressed_crc
    assert len(chunk.data) < 0.2 * chunk.uncompressed_size


def test_what_was_flushed_is_there_without_the_recording_ever_being_closed(tmp_path: Path) -> None:
    writer, imu = BagWriter(tmp_path, "scan"), imu_topic()
    for number in range(20):
        writer.write(imu, message(number))
    writer.flush()
    writer.write(imu, message(20))
    assert numbers_in(writer.path) == list(range(20))


def test_the_thread_ends_chunks_by_itself(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path, "scan")
    thread = WriterThread(writer, flush_s=0.05)
    assert thread.put(imu_topic(), message(7))
    ended = threading.Event()
    for _ in range(200):
        if McapFile(writer.path).topics:
            break
        ended.wait(0.05)
    assert numbers_in(writer.path) == [7]
    assert thread.close() is None


def test_on_a_full_disk_what_was_whole_stays_and_the_rest_is_counted_as_lost(tmp_path: Path) -> None:
    writer, imu = BagWriter(tmp_path, "scan"), imu_topic()
    generator = threading.Event()
    with file_size_limited_to(20_000):
        thread = WriterThread(writer, flush_s=0.0)
        number = 0
        while thread.error is None and number < 100_000:
            thread.put(imu, message(number, 400))
            number += 1
            generator.wait(0.001)
        assert not thread.put(imu, message(number))
        assert isinstance(thread.close(), OSError)
    kept = numbers_in(writer.path)
    assert kept == list(range(len(kept)))
    assert len(kept) > 5
    assert imu.lost > 0
    assert not (tmp_path / "metadata.yaml").exists()


def test_messages_that_the_disk_cannot_follow_are_dropped_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer, imu, gate = BagWriter(tmp_path, "scan"), imu_topic(), threading.Event()
    write = writer.write

    def slow(topic: RecordedTopic, item: RawMessage) -> None:
        gate.wait(10.0)
        write(topic, item)

    monkeypatch.setattr(writer, "write", slow)
    thread = WriterThread(writer, limit=1000)
    accepted = [thread.put(imu, message(number, 100)) for number in range(15)]
    gate.set()
    assert accepted == [True] * 10 + [False] * 5
    assert thread.close() is None
    assert (imu.messages, imu.lost) == (10, 5)
    assert numbers_in(writer.path) == list(range(10))


def test_a_disk_that_is_behind_is_told_before_anything_is_lost_and_the_rest_is_taken_in_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer, imu, gate = BagWriter(tmp_path, "scan"), imu_topic(), threading.Event()
    write = writer.write

    def slow(topic: RecordedTopic, item: RawMessage) -> None:
        gate.wait(10.0)
        write(topic, item)

    monkeypatch.setattr(writer, "write", slow)
    thread = WriterThread(writer, limit=1000)
    behind = []
    for number in range(10):
        behind.append(thread.is_behind)
        assert thread.put(imu, message(number, 100))
    thread.take_the_rest()
    assert all(thread.put(imu, message(number, 100)) for number in range(10, 30))
    gate.set()
    assert thread.close() is None
    assert behind == [False] * 6 + [True] * 4
    assert numbers_in(writer.path) == list(range(30))


def test_a_recording_that_was_cut_off_is_not_replaced_unasked(tmp_path: Path) -> None:
    out = tmp_path / "scan"
    with RecordingDirectory(out, overwrite=False) as directory:
        BagWriter(directory, "scan").close()
    assert (out / "scan_0.mcap").exists()
    with pytest.raises(OutputError, match="is not empty; choose another with --out DIR"):
        RecordingDirectory(out, overwrite=False)
    other = tmp_path / "other"
    with pytest.raises(RuntimeError), RecordingDirectory(other, overwrite=False) as directory:  # noqa: PT012
        BagWriter(directory, "other").flush()
        raise RuntimeError
    assert (tmp_path / "other.partial" / "other_0.mcap").exists()
    with pytest.raises(OutputError, match="holds a recording that was cut off"):
        RecordingDirectory(other, overwrite=False)
    with RecordingDirectory(other, overwrite=True) as directory:
        assert list(directory.iterdir()) == []


def test_a_directory_of_something_else_is_not_replaced_by_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("…")
    assert main(["record", "--out", str(tmp_path / "thesis"), "--overwrite"]) == 2
    assert "holds 'chapter.tex' but no 'thesis_0.mcap'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "complaint"), [(["--duration", "0"], "more than 0"), (["--topic", "image=x"], "image=/name")]
)
def test_arguments_are_checked(arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["record", "--out", "x", *arguments])
    assert complaint in capsys.readouterr().err
