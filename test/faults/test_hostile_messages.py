"""Hostile input: whatever comes over a topic or stands in a file is refused in one line, or harmless.

A few thousand inputs of each kind in every run; a hundred thousand in those marked slow.
"""

from __future__ import annotations

import contextlib
import dataclasses
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import gtsam
import hypothesis
import numpy as np
import pytest
import yaml
from hostile import TEXTS, Dice, corrupted, mutated, with_other_numbers
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CompressedImage, Imu
from sensor_msgs.msg import Image as ImageMessage
from tiny_bag import CALIBRATION, TYPES, TinyBag

from vli_common import cdr, geometry, messages, ply
from vli_common.calibration import parse_calibration
from vli_common.errors import CalibrationError, InputError, MessageError, VliError
from vli_common.messages.limits import LARGEST, LARGEST_VARIANCE
from vli_common.messages.pointcloud import cloud_from_rows
from vli_common.status import Health, NodeState, StageStatus
from vli_common.topics import preintegration_fields
from vli_common.types import (
    EncodedImage,
    Image,
    ImuBias,
    ImuSample,
    LaserScan,
    MapConstraints,
    PointCloud,
    PoseEstimate,
    Preintegration,
    Tracks,
    WindowPoses,
)
from vli_driver.bag import BagReader
from vli_driver.decode import decode
from vli_mapping.map_file import load_map, save_map
from vli_mapping.point_map import Columns, PointMap
from vli_mapping.snapshot import take

NS = 10**9
STAMP_NS = 1_753_000_123_456_789_012
RANDOM = np.random.default_rng(6)
decisions = st.binary(min_size=48, max_size=48)


def inputs(count: int) -> Any:
    """Return the settings for so many inputs, the same ones each time."""
    checks = [hypothesis.HealthCheck.function_scoped_fixture]
    return hypothesis.settings(max_examples=count, derandomize=True, database=None, suppress_health_check=checks)


def preintegration() -> Preintegration:
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
    measured = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias(np.full(3, 0.1), np.full(3, 0.01)))
    for _ in range(20):
        measured.integrateMeasurement(np.array([0.1, 0.2, 9.8]), RANDOM.normal(size=3), 0.005)
    return Preintegration(STAMP_NS, STAMP_NS - NS // 10, measured, 1.5, 6)


def pose() -> PoseEstimate:
    T = geometry.pose(Rotation.random(2, random_state=8).as_matrix(), RANDOM.normal(size=(2, 3)))
    return PoseEstimate(STAMP_NS, T[0], T[1], RANDOM.normal(size=3), RANDOM.normal(size=3), np.eye(6))


def tracks() -> Tracks:
    pairs = RANDOM.uniform(0, 1, (3, 6, 2))
    stripe = np.array([1.0, 2.0, np.inf, np.inf, 3.0, 4.0])
    return Tracks(STAMP_NS, True, False, np.arange(6) + 1, *pairs, np.full(6, 0.3), stripe, np.zeros(6, np.uint8), 5)


def window() -> WindowPoses:
    T = geometry.pose(Rotation.random(4, random_state=2).as_matrix(), RANDOM.normal(size=(4, 3)))
    flags = np.zeros(4, np.bool_)
    return WindowPoses(STAMP_NS, STAMP_NS + np.arange(4), np.zeros(4, np.uint8), flags, flags, T, 4)


def constraints() -> MapConstraints:
    normals = np.tile([0.0, 0.6, 0.8], (5, 1))
    points = RANDOM.normal(size=(2, 5, 3))
    return MapConstraints(STAMP_NS, STAMP_NS + np.arange(5), *points, normals, np.full(5, 1e-4), np.full(5, 0.5), 9)


def cloud() -> PointCloud:
    points = RANDOM.normal(size=(5, 3)).astype(np.float32)
    return PointCloud(STAMP_NS, points, np.zeros((5, 3), np.uint8), points, np.ones(5, np.float32), 2)


@dataclass(frozen=True)
class Kind:
    """A good message, and who reads it."""

    good: Any
    read: Callable[[Any], Any]


BGR = EncodedImage(STAMP_NS, bytes(192), "bgr8", 8, 8, 24, exposure_s=0.001, laser_on=True)
KINDS = {
    "laser_points": Kind(
        messages.scan_to_message(LaserScan(STAMP_NS, *RANDOM.uniform(0, 1, (1, 6, 3)), *RANDOM.uniform(0, 1, (1, 6, 2)),
                                           np.ones(6), np.ones(6), 3)),
        messages.scan_from_message,
    ),
    "tracks": Kind(messages.tracks_to_message(tracks()), messages.tracks_from_message),
    "window": Kind(messages.window_to_message(window()), messages.window_from_message),
    "map_constraints": Kind(messages.constraints_to_message(constraints()), messages.constraints_from_message),
    "map": Kind(messages.cloud_to_message(cloud()), messages.cloud_from_message),
    "preintegration": Kind(messages.preintegration_to_message(preintegration()), messages.preintegration_from_message),
    "no preintegration": Kind(messages.no_preintegration_message(STAMP_NS, 3), messages.preintegration_from_message),
    "imu": Kind(
        deserialize_message(messages.imu_to_cdr(ImuSample(STAMP_NS, np.ones(3), np.ones(3))), Imu), messages.imu_from_message
    ),
    "bias": Kind(messages.bias_to_message(ImuBias(STAMP_NS, np.ones(3), np.ones(3))), messages.bias_from_message),
    "odometry": Kind(messages.odometry_to_message(pose()), messages.odometry_from_message),
    "pose": Kind(messages.pose_to_message(pose()), messages.pose_from_message),
    "tf": Kind(messages.pose_transforms(pose())[0], messages.transform_from_message),
    "image_long": Kind(
        deserialize_message(messages.image_to_cdr(Image(STAMP_NS, np.zeros((8, 8, 3), np.uint8))), ImageMessage),
        messages.image_from_message,
    ),
    "image_raw": Kind(deserialize_message(messages.encoded_to_cdr(BGR), ImageMessage), messages.encoded_from_message),
    "compressed": Kind(
        deserialize_message(
            messages.encoded_to_cdr(EncodedImage(STAMP_NS, b"\xff\xd8", "jpeg", compressed=True)), CompressedImage
        ),
        messages.encoded_from_message,
    ),
    "exposure": Kind(messages.exposure_to_message(BGR), messages.exposure_from_message),
    "session": Kind(messages.session_to_message(messages.Session(3, "why", STAMP_NS)), messages.session_from_message),
    "status": Kind(
        messages.status_to_message(StageStatus(STAMP_NS, "a_node", Health.OK, NodeState.READY, "hint", {"key": "1"})),
        messages.status_from_message,
    ),
}  # fmt: skip


def assert_sound(value: Any) -> None:
    """Assert that what a message came to has no number that a stage would have to be afraid of."""
    if isinstance(value, tuple):
        for item in value:
            assert_sound(item)
    elif dataclasses.is_dataclass(value):
        for item in dataclasses.fields(value):
            number = getattr(value, item.name)
            assert not item.name.endswith("stamp_ns") or 0 <= number < 2**31 * NS
            if item.name == "stripe_px":
                number = number[~np.isinf(number)]
            assert_sound(number)
    elif isinstance(value, np.ndarray) and value.dtype.kind == "f":
        assert (np.abs(value) <= 10 * LARGEST_VARIANCE).all()


def assert_one_line(error: VliError) -> None:
    """Assert that a refusal is what a log can take."""
    line = str(error)
    assert len(line) < 3000
    assert "\n" not in line


def read_hostile(data: bytes) -> None:
    """Read a mutation of some message: it is refused as malformed, or sound."""
    dice = Dice(data)
    kind = KINDS[dice.of(sorted(KINDS))]
    read_one(kind.read, mutated(kind.good, dice))


def read_one(read: Callable[[Any], Any], message: Any) -> None:
    try:
        value = read(message)
    except MessageError as error:
        assert_one_line(error)
        return
    assert_sound(value)


WIRED = {name: cdr.READERS[kind] for name, kind in (
    ("imu", cdr.IMU), ("image_long", cdr.IMAGE), ("image_raw", cdr.IMAGE), ("compressed", cdr.COMPRESSED_IMAGE),
)}  # fmt: skip
"""Kinds that the nodes read from the bytes of the message."""


def read_hostile_bytes(data: bytes) -> None:
    """Read a mutation of some message, or of its bytes, as they come over the wire in either order: refused, or sound."""
    dice = Dice(data)
    name = dice.of(sorted(WIRED))
    kind, type_name = KINDS[name], type(KINDS[name].good).__name__
    message = mutated(kind.good, dice) if dice.below(2) else kind.good
    wire = serialize_message(message)
    if dice.below(2):
        name_in_store = f"sensor_msgs/msg/{type_name}"
        with contextlib.suppress(UnicodeDecodeError):
            wire = bytes(TYPES.serialize_cdr(TYPES.deserialize_cdr(wire, name_in_store), name_in_store, little_endian=False))
    if message is kind.good or dice.below(2):
        wire = corrupted(wire, dice)
    read_one(lambda item: kind.read(cdr.read(WIRED[name], item)), wire)


@inputs(2000)
@given(decisions)
def test_a_mutated_message_is_refused_or_sound(data):
    read_hostile(data)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@inputs(100_000)
@given(decisions)
def test_a_hundred_thousand_mutated_messages_are_refused_or_sound(data):
    read_hostile(data)


@inputs(3000)
@given(decisions)
def test_mutated_bytes_of_a_message_are_refused_or_sound(data):
    read_hostile_bytes(data)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@inputs(100_000)
@given(decisions)
def test_a_hundred_thousand_mutated_bytes_of_messages_are_refused_or_sound(data):
    read_hostile_bytes(data)


@pytest.mark.parametrize("name", sorted(KINDS))
def test_the_good_messages_are_good(name):
    assert_sound(KINDS[name].read(KINDS[name].good))
    if name in WIRED:
        assert_sound(KINDS[name].read(cdr.read(WIRED[name], serialize_message(KINDS[name].good))))


ARCHIVE = preintegration().measurements.serialize()


def archived(text: str) -> Any:
    """Return the message of an archive, its checksum right: from a sender who means it."""
    data = text.encode()
    row = np.zeros(1, preintegration_fields(len(data)))
    row["from_sec"], row["from_nanosec"] = divmod(STAMP_NS - NS // 10, NS)
    row["inflate"], row["crc32"], row["data"] = 1.0, zlib.crc32(data), np.frombuffer(data, np.uint8)
    return cloud_from_rows(row, messages.header(STAMP_NS, "imu_link"), 6)


def use_archive(text: str) -> None:
    """Let GTSAM make a factor of an archive that is accepted, and take its residual and derivatives."""
    try:
        found = messages.preintegration_from_message(archived(text))
    except MessageError:
        return
    factor = gtsam.CombinedImuFactor(*range(6), found.measurements)
    values = gtsam.Values()
    for key in (0, 2):
        values.insert(key, gtsam.Pose3())
        values.insert(key + 1, np.zeros(3))
    for key in (4, 5):
        values.insert(key, gtsam.imuBias.ConstantBias())
    assert np.isfinite(factor.error(values))
    assert np.isfinite(factor.linearize(values).jacobian()[0]).all()


@inputs(600)
@given(decisions)
def test_a_preintegration_of_other_numbers_is_refused_or_makes_a_sound_factor(data):
    use_archive(with_other_numbers(ARCHIVE, Dice(data)))


@inputs(600)
@given(decisions)
def test_a_preintegration_of_other_bytes_never_ends_the_process(data):
    use_archive(corrupted(ARCHIVE.encode(), Dice(data)).decode("latin-1").encode("ascii", "replace").decode())


PIXELS = RANDOM.integers(0, 255, (24, 32, 3), dtype=np.uint8)
DEEP = PIXELS[:, :, 0].astype(np.uint16) * 200
FILES = [
    ("bgr8; jpeg compressed bgr8", cv2.imencode(".jpg", PIXELS)[1].tobytes()),
    ("png", cv2.imencode(".png", PIXELS)[1].tobytes()),
    ("bayer_rggb8; png compressed", cv2.imencode(".png", PIXELS[:, :, 0])[1].tobytes()),
    ("bayer_rggb16; png compressed", cv2.imencode(".png", DEEP)[1].tobytes()),
    ("bayer_grbg8; jpeg compressed", cv2.imencode(".jpg", PIXELS[:, :, 0])[1].tobytes()),
]
ENCODINGS = ("bayer_rggb8", "bayer_grbg16", "rgb8", "bgr8", "mono8", "rgb16", "mono16", "16UC1", "")
SIZES = (1, 2, 3, 4, 5, 8, 0, 640, 65535, 2**31 - 1, 2**32 - 1)


def hostile_image(dice: Dice) -> EncodedImage:
    if dice.below(2):
        encoding, data = dice.of(FILES)
        return EncodedImage(1, corrupted(data, dice), dice.of((encoding, encoding, *TEXTS)), compressed=True)
    width, height = dice.of(SIZES), dice.of(SIZES)
    step = dice.of((width, 2 * width, 3 * width, 6 * width, width + 1, 0))
    size = min(dice.of((step * height, step * height + 1, max(0, step * height - 1), 0)), 100_000)
    return EncodedImage(1, bytes(size), dice.of(ENCODINGS), width, height, step)


def decode_hostile(data: bytes) -> None:
    dice = Dice(data)
    image = hostile_image(dice)
    try:
        pixels = decode(image, dice.of(("native", "grey"))).pixels
    except InputError as error:
        assert_one_line(error)
        return
    assert pixels.dtype == np.uint8
    assert pixels.size
    assert pixels.ndim == 2 or pixels.shape[2] == 3


@inputs(1000)
@given(decisions)
def test_a_mutated_image_is_refused_or_has_pixels(data):
    decode_hostile(data)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@inputs(30_000)
@given(decisions)
def test_thirty_thousand_mutated_images_are_refused_or_have_pixels(data):
    decode_hostile(data)


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """Return the bytes of one small bag: in zstd, lz4 and plain chunks, without checksums, and without chunks."""
    place = tmp_path_factory.mktemp("bags")
    items = list(TinyBag(seconds=0.1, size=(16, 16), imu_topics=()).messages())
    forms = [(kind, True, True) for kind in (CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE)]
    forms += [(CompressionType.NONE, False, True), (CompressionType.NONE, False, False)]
    written = []
    for number, (compression, crcs, chunks) in enumerate(forms):
        path = place / f"{number}.mcap"
        with path.open("wb") as stream:
            writer = Writer(stream, compression=compression, chunk_size=1500, enable_crcs=crcs, use_chunking=chunks)
            writer.start("ros2", "test")
            kind = items[0][2].__msgtype__
            channel = writer.register_channel(items[0][0], "cdr", writer.register_schema(kind, "ros2msg", b"x"))
            for _, log_ns, message in items:
                writer.add_message(channel, log_ns, bytes(TYPES.serialize_cdr(message, kind)), log_ns)
            writer.finish()
        written.append(path.read_bytes())
    return written


def read_rotten(bags: list[bytes], data: bytes, place: Any) -> None:
    dice = Dice(data)
    path = place / "rotten.mcap"
    path.write_bytes(corrupted(dice.of(bags), dice))
    try:
        reader = BagReader(path, TinyBag.topics_without_imu(), 0.0, dice.of((None, 0.05)))
        assert sum(1 for _ in reader) < 100
        list(reader.images())
    except VliError as error:
        assert_one_line(error)
        return
    assert len(reader.warnings) < 20


@inputs(400)
@given(data=decisions)
def test_a_rotten_bag_is_read_as_far_as_it_is_whole(bags, tmp_path, data):
    read_rotten(bags, data, tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@inputs(20_000)
@given(data=decisions)
def test_twenty_thousand_rotten_bags_are_read_as_far_as_they_are_whole(bags, tmp_path, data):
    read_rotten(bags, data, tmp_path)


@pytest.fixture(scope="module")
def small_map(tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "map.vli"
    save_map(path, take(PointMap(), None))
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    return path.read_bytes(), entries


@inputs(400)
@given(data=decisions)
def test_a_rotten_map_is_refused_or_whole(small_map, tmp_path, data):
    whole, entries = small_map
    dice, path = Dice(data), tmp_path / "rotten.vli"
    if dice.below(3) == 0:
        path.write_bytes(corrupted(whole, dice))
    else:
        name = dice.of(sorted(entries))
        with zipfile.ZipFile(path, "w", dice.of((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
            for entry, content in entries.items():
                archive.writestr(entry, corrupted(content, dice) if entry == name else content)
    try:
        snapshot = load_map(path)
    except InputError as error:
        assert_one_line(error)
        return
    assert isinstance(snapshot.columns, Columns)


@inputs(300)
@given(data=decisions)
def test_a_rotten_cloud_is_refused_or_whole(tmp_path, data):
    path = tmp_path / "rotten.ply"
    ply.write_cloud(path, cloud())
    path.write_bytes(corrupted(path.read_bytes(), Dice(data)))
    try:
        assert ply.read_cloud(path).points.shape[1] == 3
    except InputError:
        return


TEXT = yaml.safe_dump(CALIBRATION)


@inputs(300)
@given(data=decisions)
def test_a_mutated_calibration_is_refused_or_a_calibration(data):
    text = corrupted(TEXT.encode(), Dice(data)).decode("utf-8", "replace")
    try:
        calibration = parse_calibration(text)
    except CalibrationError as error:
        assert_one_line(error)
        return
    assert calibration.laser is not None
    assert abs(calibration.timeshift_ns) <= 10 * NS
    assert LARGEST > calibration.rate_hz > 0
