from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recordings import IMU_SAMPLES, START_NS, STORE, T, header, imu, standard, write, write_mcap

from vli_common.errors import MessageError
from vli_common.types import ImuSample
from vli_driver import cdr
from vli_driver.bag import BagReader, BagTopics


def test_blocks_hold_the_same_samples_as_the_bag_read_one_by_one(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", standard())
    single = [item for item in BagReader(path) if isinstance(item, ImuSample)]
    blocks = list(BagReader(path).imu_blocks(64))
    assert [len(stamps) for stamps, _, _ in blocks] == [64, 64, 64, 8]
    stamps, gyro, accel = (np.concatenate(column) for column in zip(*blocks, strict=True))
    assert stamps.tolist() == [sample.stamp_ns for sample in single]
    assert np.array_equal(gyro, [sample.gyro for sample in single])
    assert np.array_equal(accel, [sample.accel for sample in single])


def test_a_bag_without_images_is_read_where_none_are_required(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", (item for item in standard() if item[1] == "/imu"))
    reader = BagReader(path, BagTopics(image_required=False))
    assert reader.image_topic == ""
    assert sum(len(stamps) for stamps, _, _ in reader.imu_blocks()) == IMU_SAMPLES


def test_messages_of_different_lengths_are_read_too() -> None:
    long = replace(imu(START_NS + 5), header=T["std_msgs/msg/Header"](header(START_NS + 5).stamp, "a_longer_frame_id"))
    data = [bytes(STORE.serialize_cdr(message, message.__msgtype__)) for message in (imu(START_NS), long)]
    stamps, gyro, _ = cdr.read_imus(data)
    assert stamps.tolist() == [START_NS, START_NS + 5]
    assert gyro[:, 0] == pytest.approx(0.1)


def test_messages_of_one_length_that_are_laid_out_differently_are_read_as_each_is() -> None:
    long = replace(imu(START_NS), header=T["std_msgs/msg/Header"](header(START_NS).stamp, "a_longer_frame_id"))
    short, long = (bytes(STORE.serialize_cdr(message, message.__msgtype__)) for message in (imu(START_NS), long))
    _, gyro, accel = cdr.read_imus([long, short + bytes(len(long) - len(short))])
    assert np.array_equal(gyro[0], gyro[1])
    assert np.array_equal(accel[0], accel[1])


def test_a_malformed_message_is_an_error_of_its_own_and_dropped_from_a_bag(tmp_path: Path) -> None:
    good = bytes(STORE.serialize_cdr(imu(START_NS), "sensor_msgs/msg/Imu"))
    with pytest.raises(MessageError):
        cdr.read_imus([good, good[:50]])
    path = write_mcap(tmp_path / "bag.mcap", [(START_NS + k, "/imu", imu(START_NS + k)) for k in range(3)])
    reader = BagReader(path, BagTopics(image_required=False))
    raw = [item.data for item in reader._raw({"/imu"})]
    raw[1] = raw[1][:60]
    reader._raw = lambda topics: iter([type("Raw", (), {"data": item})() for item in raw])  # type: ignore[assignment]
    assert [stamps.tolist() for stamps, _, _ in reader.imu_blocks()] == [[START_NS, START_NS + 2]]
    assert reader.counters["malformed"] == 1
