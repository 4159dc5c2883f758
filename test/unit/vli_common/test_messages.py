"""Messages: what goes out comes back, bit for bit where the wire allows it; what is malformed is refused."""

from __future__ import annotations

import array
import copy
import dataclasses
import re
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CompressedImage, Imu, PointCloud2, PointField
from sensor_msgs.msg import Image as ImageMessage
from std_msgs.msg import Header

from vli_common import cdr, geometry, messages
from vli_common.errors import MessageError
from vli_common.messages.pointcloud import cloud_from_rows, field_count, pack_rgb, unpack_rgb
from vli_common.messages.poses import from_vector
from vli_common.status import Health, NodeState, StageStatus
from vli_common.topics import TOPICS, TRACKS_FIELDS, preintegration_fields
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
    Relocalisation,
    TrackFlag,
    Tracks,
    WindowPoses,
)

STAMP_NS = 1_753_000_123_456_789_012
stamps = st.integers(0, 2**31 * 10**9 - 1)
sessions = st.integers(0, 2**32 - 1)
finite = st.floats(-1e6, 1e6)
RANDOM = np.random.default_rng(11)


def through_the_wire(message: Any) -> Any:
    """Return the message as a subscriber gets it."""
    return deserialize_message(serialize_message(message), type(message))


def assert_same(a: Any, b: Any, rtol: float = 0.0) -> None:
    assert type(a) is type(b)
    for item in dataclasses.fields(a):
        left, right = getattr(a, item.name), getattr(b, item.name)
        if isinstance(left, np.ndarray):
            assert left.dtype == right.dtype, item.name
            np.testing.assert_allclose(left, right, rtol=rtol, atol=rtol, err_msg=item.name)
        else:
            assert left == right, item.name


def scan_of(count: int, stamp_ns: int = STAMP_NS, session: int = 3) -> LaserScan:
    values = RANDOM.normal(size=(count, 7)).astype(np.float32).astype(np.float64)
    return LaserScan(stamp_ns, values[:, :3], values[:, 3:5], values[:, 5], values[:, 6], session)


def tracks_of(count: int) -> Tracks:
    stripe = RANDOM.uniform(0, 50, count)
    stripe[: count // 2] = np.inf
    return Tracks(
        STAMP_NS, True, False, RANDOM.permutation(count) + 1, RANDOM.uniform(0, 640, (count, 2)), RANDOM.normal(size=(count, 2)),
        RANDOM.normal(size=(count, 2)), RANDOM.uniform(0.1, 1, count), stripe,
        RANDOM.integers(0, 16, count).astype(np.uint8), 5,
    )  # fmt: skip


def window_of(count: int) -> WindowPoses:
    T = geometry.pose(Rotation.random(count, random_state=2).as_matrix(), RANDOM.normal(size=(count, 3)))
    kinds, flags = RANDOM.integers(0, 3, count).astype(np.uint8), RANDOM.random((2, count)) < 0.5
    located, placement = count % 2 == 0, 3 if count else 0
    stamps = STAMP_NS - 10_000_000 * np.arange(count)[::-1]
    return WindowPoses(STAMP_NS, stamps, kinds, flags[0], flags[1], T, 4, located, placement)


def constraints_of(count: int) -> MapConstraints:
    normals = RANDOM.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return MapConstraints(
        STAMP_NS, STAMP_NS - RANDOM.integers(0, 10**9, count), RANDOM.normal(size=(count, 3)), RANDOM.normal(size=(count, 3)),
        normals, RANDOM.uniform(1e-5, 1e-3, count), RANDOM.random(count), 9,
    )  # fmt: skip


def cloud_of(count: int, with_normals: bool) -> PointCloud:
    points, normals = RANDOM.normal(size=(2, count, 3)).astype(np.float32)
    colours = RANDOM.integers(0, 256, (count, 3)).astype(np.uint8)
    weights = RANDOM.integers(1, 20, count).astype(np.float32)
    return PointCloud(STAMP_NS, points, colours, normals if with_normals else None, weights if with_normals else None, 2)


def pose_estimate() -> PoseEstimate:
    root = RANDOM.normal(size=(6, 6))
    T = geometry.pose(Rotation.random(2, random_state=8).as_matrix(), RANDOM.normal(size=(2, 3)))
    return PoseEstimate(STAMP_NS, T[0], T[1], RANDOM.normal(size=3), RANDOM.normal(size=3), root @ root.T)


def preintegration_of(samples: int = 60, inflate: float = 1.5) -> Preintegration:
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
    params.setAccelerometerCovariance(np.eye(3) * 4e-6)
    params.setGyroscopeCovariance(np.eye(3) * 1e-7)
    bias = gtsam.imuBias.ConstantBias(np.array([0.1, 0.2, -0.3]), np.array([0.01, 0.02, 0.03]))
    measurements = gtsam.PreintegratedCombinedMeasurements(params, bias)
    for _ in range(samples):
        measurements.integrateMeasurement(np.array([0.1, 0.2, 9.8]), RANDOM.normal(size=3), 0.005)
    return Preintegration(STAMP_NS, STAMP_NS - samples * 5_000_000, measurements, inflate, 6)


CLOUDS: dict[str, tuple[Any, Callable[..., PointCloud2], Callable[[PointCloud2], Any]]] = {
    "laser_points": (scan_of(50), messages.scan_to_message, messages.scan_from_message),
    "tracks": (tracks_of(40), messages.tracks_to_message, messages.tracks_from_message),
    "window": (window_of(30), messages.window_to_message, messages.window_from_message),
    "map_constraints": (constraints_of(20), messages.constraints_to_message, messages.constraints_from_message),
    "cloud": (cloud_of(60, False), messages.cloud_to_message, messages.cloud_from_message),
    "map": (cloud_of(60, True), messages.cloud_to_message, messages.cloud_from_message),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_every_cloud_comes_back_as_it_went(name: str) -> None:
    value, write, read = CLOUDS[name]
    message = through_the_wire(write(value))
    # Poses go through a quaternion: equal to rounding, all else to the bit.
    assert_same(read(message), value, rtol=1e-14 if name == "window" else 0.0)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == divmod(STAMP_NS, 10**9)


@pytest.mark.parametrize("name", CLOUDS)
def test_the_fields_of_every_cloud_are_those_of_the_table(name: str) -> None:
    value, write, _ = CLOUDS[name]
    (topic,) = [topic for topic in TOPICS if topic.name == name]
    assert topic.fields is not None
    assert tuple(item.name for item in write(value).fields) == topic.fields.names


@pytest.mark.parametrize("name", [name for name in CLOUDS if name != "tracks"])
def test_an_empty_cloud_still_says_of_which_session_it_is(name: str) -> None:
    value, write, read = CLOUDS[name]
    empty = dataclasses.replace(
        value, **{f.name: v[:0] for f in dataclasses.fields(value) if isinstance(v := getattr(value, f.name), np.ndarray)}
    )
    message = through_the_wire(write(empty))
    assert message.width == 0
    assert len(read(message)) == 0
    assert read(message).session == value.session


def test_a_frame_without_tracks_is_still_a_frame() -> None:
    empty = np.empty((0, 2))
    none = Tracks(
        STAMP_NS, False, True, np.empty(0, np.int64), empty, empty, empty, empty[:, 0], empty[:, 0], np.empty(0, np.uint8), 1
    )
    message = messages.tracks_to_message(none)
    assert message.width == 1
    assert messages.tracks_from_message(message).stationary


@settings(deadline=None)
@given(arrays(np.float32, st.tuples(st.integers(0, 30), st.just(7)), elements=st.floats(-1e6, 1e6, width=32)), stamps, sessions)
def test_any_scan_comes_back(values: np.ndarray, stamp_ns: int, session: int) -> None:
    wide = values.astype(np.float64)
    scan = LaserScan(stamp_ns, wide[:, :3], wide[:, 3:5], wide[:, 5], wide[:, 6], session)
    assert_same(messages.scan_from_message(through_the_wire(messages.scan_to_message(scan))), scan)


@settings(deadline=None)
@given(arrays(np.float64, st.tuples(st.integers(0, 20), st.just(8)), elements=finite), stamps, st.booleans(), st.booleans())
def test_any_tracks_come_back_to_the_last_bit(values: np.ndarray, stamp_ns: int, keyframe: bool, stationary: bool) -> None:
    ids, flags = np.arange(1, len(values) + 1), np.full(len(values), TrackFlag.NEW, np.uint8)
    columns = (values[:, :2], values[:, 2:4], values[:, 4:6], values[:, 6], values[:, 7])
    tracks = Tracks(stamp_ns, keyframe, stationary, ids, *columns, flags, 7)
    assert_same(messages.tracks_from_message(through_the_wire(messages.tracks_to_message(tracks))), tracks)


@given(arrays(np.uint8, st.tuples(st.integers(0, 40), st.just(3))))
def test_any_colour_survives_the_bits_of_a_float(colours: np.ndarray) -> None:
    packed = pack_rgb(colours)
    np.testing.assert_array_equal(unpack_rgb(packed), colours)
    np.testing.assert_array_equal(packed.view("<u4"), colours.astype(np.uint32) @ [65536, 256, 1])


@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 3), (1, 1), (2, 3, 3)])
def test_images_come_back_as_arrays_that_a_kernel_is_compiled_for(shape: tuple[int, ...]) -> None:
    image = Image(STAMP_NS, RANDOM.integers(0, 256, shape).astype(np.uint8), session=2)
    data = messages.image_to_cdr(image)
    for message in (cdr.read(cdr.image, data), deserialize_message(data, ImageMessage)):
        again = messages.image_from_message(message, session=2)
        assert_same(again, image)
        assert again.pixels.flags.writeable
        assert again.pixels.flags.c_contiguous


def test_the_padding_of_image_rows_is_left_out() -> None:
    data = np.arange(2 * 8, dtype=np.uint8)
    message = ImageMessage(height=2, width=2, encoding="bgr8", step=8, data=array.array("B", data.tobytes()))
    pixels = messages.image_from_message(message).pixels
    np.testing.assert_array_equal(pixels, data.reshape(2, 8)[:, :6].reshape(2, 2, 3))
    assert pixels.flags.c_contiguous


@pytest.mark.parametrize(
    "image",
    [
        EncodedImage(STAMP_NS, bytes(range(24)), "bayer_rggb8", 6, 4, 6),
        EncodedImage(STAMP_NS, bytes(range(24)), "mono16", 3, 4, 6),
        EncodedImage(STAMP_NS, b"\xff\xd8 a jpeg", "jpeg", compressed=True),
        EncodedImage(STAMP_NS, b"\x89PNG", "bayer_rggb8; png compressed", compressed=True),
    ],
)
def test_camera_images_go_through_undecoded(image: EncodedImage) -> None:
    data = messages.encoded_to_cdr(image)
    ours = cdr.read(cdr.compressed_image if image.compressed else cdr.image, data)
    for message in (ours, deserialize_message(data, CompressedImage if image.compressed else ImageMessage)):
        assert messages.encoded_from_message(message) == image


@given(arrays(np.float64, (2, 3), elements=finite), stamps)
def test_imu_samples_and_biases_come_back(values: np.ndarray, stamp_ns: int) -> None:
    sample, bias = ImuSample(stamp_ns, *values), ImuBias(stamp_ns, *values, session=8)
    data = messages.imu_to_cdr(sample)
    for message in (cdr.read(cdr.imu, data), deserialize_message(data, Imu)):
        assert_same(messages.imu_from_message(message), sample)
    assert_same(messages.bias_from_message(messages.bias_to_message(bias), 8), bias)


def test_preintegration_comes_back_with_all_its_digits() -> None:
    sent = preintegration_of()
    got = messages.preintegration_from_message(through_the_wire(messages.preintegration_to_message(sent)))
    assert (got.stamp_ns, got.from_ns, got.inflate, got.session) == (sent.stamp_ns, sent.from_ns, 1.5, 6)
    assert got.measurements.serialize() == sent.measurements.serialize()  # type: ignore[attr-defined]


def test_odometry_is_the_pose_in_odom_with_its_covariance_and_twist_turned() -> None:
    pose = pose_estimate()
    message = through_the_wire(messages.odometry_to_message(pose))
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "imu_link")
    again = messages.odometry_from_message(message, pose.T_map_odom)
    assert_same(again, pose, rtol=1e-12)
    expected = pose.T_map_imu[:3, :3].T @ pose.velocity
    np.testing.assert_allclose(from_vector(message.twist.twist.linear), expected)


def test_transforms_chain_from_map_to_the_imu() -> None:
    pose = pose_estimate()
    (_, a, b, first), (_, c, d, second) = (messages.transform_from_message(item) for item in messages.pose_transforms(pose))
    assert (a, b, c, d) == ("map", "odom", "odom", "imu_link")
    np.testing.assert_allclose(first @ second, pose.T_map_imu, atol=1e-14)
    stamp_ns, T = messages.pose_from_message(through_the_wire(messages.pose_to_message(pose)))
    assert stamp_ns == STAMP_NS
    np.testing.assert_allclose(T, pose.T_map_imu, atol=1e-15)


def test_paths_and_relocalisations_come_back() -> None:
    pose = pose_estimate()
    ((stamp_ns, T),) = messages.path_from_message(messages.path_to_message([messages.pose_to_message(pose)]))
    assert stamp_ns == STAMP_NS
    np.testing.assert_allclose(T, pose.T_map_imu, atol=1e-15)
    found = Relocalisation(STAMP_NS, pose.T_map_odom, 2e-4, 3)
    message = through_the_wire(messages.relocalisation_to_message(found))
    back = messages.relocalisation_from_message(message, 3)
    assert (back.stamp_ns, back.session) == (found.stamp_ns, found.session)
    assert back.sigma_m == pytest.approx(found.sigma_m)
    np.testing.assert_allclose(back.T_map_session, found.T_map_session, atol=1e-15)
    message.pose.covariance[0] = -1.0
    with pytest.raises(MessageError, match="variances"):
        messages.relocalisation_from_message(message)


def test_sessions_and_statuses_come_back() -> None:
    session = messages.Session(12, "clock jumped: by -3 s", STAMP_NS)
    assert messages.session_from_message(through_the_wire(messages.session_to_message(session))) == session
    for hint in ("", "no IMU since 2 s"):
        status = StageStatus(STAMP_NS, "frontend_node", Health.WARN, NodeState.READY, hint, {"rate_hz": "30.0"})
        assert messages.status_from_message(through_the_wire(messages.status_to_message(status))) == status


def test_every_topic_of_the_table_is_named_once_and_has_a_known_type() -> None:
    assert len({topic.name for topic in TOPICS}) == len(TOPICS)
    for topic in TOPICS:
        package, _, name = topic.type.split("/")
        if package != "tf2_msgs":
            assert hasattr(__import__(f"{package}.msg", fromlist=[name]), name)


# What is refused


def broken(name: str, **changes: Any) -> PointCloud2:
    value, write, _ = CLOUDS[name]
    message = copy.deepcopy(write(value))
    for key, change in changes.items():
        setattr(message, key, change)
    return message


def with_field(message: PointCloud2, field: str, **changes: Any) -> PointCloud2:
    for item in message.fields:
        if item.name == field:
            for key, change in changes.items():
                setattr(item, key, change)
    return message


def with_value(name: str, field: str, value: float) -> PointCloud2:
    """Return a good cloud with one value of its second row replaced."""
    message = broken(name)
    (topic,) = [topic for topic in TOPICS if topic.name == name]
    np.frombuffer(message.data, topic.fields)[field][1] = value
    return message


@pytest.mark.parametrize(
    ("message", "complaint"),
    [
        (broken("laser_points", is_bigendian=True), "big-endian"),
        (broken("laser_points", fields=[]), "no field 'x', it has ''"),
        (with_field(broken("laser_points"), "sigma", name="sigm"), "no field 'sigma'"),
        (with_field(broken("laser_points"), "x", datatype=8), "field 'x' has type '<f8' × '1', expected '<f4' × '1'"),
        (with_field(broken("laser_points"), "x", count=2), "field 'x' has type '<f4' × '2'"),
        (with_field(broken("laser_points"), "x", offset=2**32 - 4), "ends outside points of '32' bytes"),
        (with_field(broken("laser_points"), "y", name="x"), "a field twice"),
        (broken("laser_points", width=51), "does not fit its '1600' bytes"),
        (broken("laser_points", width=2**32 - 1, height=2**32 - 1), "does not fit its '1600' bytes"),
        (broken("laser_points", width=0, height=2**32 - 1, row_step=0), "does not fit its '1600' bytes"),
        (broken("laser_points", point_step=0), "ends outside points of '0' bytes"),
        (broken("laser_points", row_step=0), "does not fit"),
        (broken("laser_points", data=array.array("B")), "does not fit its '0' bytes"),
        (broken("laser_points", width=0, row_step=0, data=array.array("B")), "does not say of which session"),
        (broken("laser_points", fields=[PointField(name=str(i)) for i in range(65)]), "'65' fields"),
        (with_value("laser_points", "z", float("nan")), "field 'z' has 'nan'"),
        (with_value("laser_points", "sigma", float("inf")), "field 'sigma' has 'inf'"),
        (with_value("laser_points", "session", 99), "rows of sessions '3' to '99'"),
    ],
)
def test_a_malformed_cloud_is_refused_with_the_reason(message: PointCloud2, complaint: str) -> None:
    with pytest.raises(MessageError) as caught:
        messages.scan_from_message(message)
    assert complaint in str(caught.value)


@pytest.mark.parametrize(
    ("name", "field", "value", "complaint"),
    [
        ("tracks", "stripe_px", float("nan"), "field 'stripe_px' has 'nan'"),
        ("tracks", "id", 0, "an id '0' or one id twice"),
        ("window", "kind", 3, "kind '3', expected 0 to 2"),
        ("window", "sec", 2**31, "stamp outside"),
        ("window", "nanosec", 10**9, "stamp outside"),
        ("window", "sec", 0, "do not ascend"),
        ("window", "qw", 5.0, "quaternion that is not unit"),
        ("map_constraints", "nx", 5.0, "normal that is not unit"),
        ("map_constraints", "weight", 1.5, "weight outside 0 to 1"),
        ("map_constraints", "sigma", 0.0, "sigma that is not positive"),
        ("map", "weight", float("nan"), "field 'weight' has 'nan'"),
    ],
)
def test_an_impossible_value_is_refused_with_the_reason(name: str, field: str, value: float, complaint: str) -> None:
    with pytest.raises(MessageError) as caught:
        CLOUDS[name][2](with_value(name, field, value))
    assert complaint in str(caught.value)


def test_tracks_without_the_row_of_the_frame_are_refused() -> None:
    message = broken("tracks")
    np.frombuffer(message.data, TRACKS_FIELDS)["id"][0] = 77
    with pytest.raises(MessageError, match="no row 0"):
        messages.tracks_from_message(message)


@pytest.mark.parametrize(
    "changes",
    [
        {"width": 2**32 - 1}, {"height": 2**32 - 1}, {"width": 0}, {"height": 0}, {"step": 5}, {"step": 2**32 - 1},
        {"encoding": "rgb8"}, {"data": array.array("B")},
    ],
)  # fmt: skip
def test_an_image_whose_sizes_do_not_fit_is_refused(changes: dict[str, Any]) -> None:
    message = deserialize_message(messages.image_to_cdr(Image(STAMP_NS, np.zeros((4, 6, 3), np.uint8))), ImageMessage)
    for key, value in changes.items():
        setattr(message, key, value)
    with pytest.raises(MessageError):
        messages.image_from_message(message)
    if "encoding" not in changes and "step" not in changes:
        with pytest.raises(MessageError):
            messages.encoded_from_message(message)


def preintegration_message(
    edit: Callable[[str], str] = lambda text: text, keep_checksum: bool = False, **row: Any
) -> PointCloud2:
    """Return a preintegration message whose archive is edited and whose checksum is right nevertheless."""
    import zlib

    message = messages.preintegration_to_message(preintegration_of())
    layout = preintegration_fields(field_count(message, "data"))
    rows = np.frombuffer(message.data, layout)
    data = edit(rows["data"].tobytes().decode()).encode()
    again = np.zeros(1, preintegration_fields(len(data)))
    for name in ("from_sec", "from_nanosec", "inflate", "crc32"):
        again[name] = row.get(name, rows[name])
    again["data"] = np.frombuffer(data, np.uint8)
    if not keep_checksum and "crc32" not in row:
        again["crc32"] = zlib.crc32(data)
    return cloud_from_rows(again, message.header, 6)


def first_number(text: str, replacement: str) -> str:
    token = next(token for token in text.split() if "e-0" in token)
    return text.replace(token, replacement, 1)


def last_number(text: str, replacement: str, place: int = -1) -> str:
    numbers = list(re.finditer(r"-?\d\.\d+e[+-]\d+", text))
    return text[: numbers[place].start()] + replacement + text[numbers[place].end() :]


@pytest.mark.parametrize(
    ("message", "complaint"),
    [
        (preintegration_message(crc32=1), "checksum"),
        (preintegration_message(lambda text: text.replace("1", "2", 1), keep_checksum=True), "checksum"),
        (preintegration_message(lambda text: text[:4000]), "another form"),
        (preintegration_message(lambda text: "gibberish"), "another form"),
        (preintegration_message(lambda text: text.replace("35 gtsam", "2147483647 gtsam")), "another form"),
        (preintegration_message(lambda text: text.replace(" 3 3 ", " 999999 999999 ")), "another form"),
        (preintegration_message(lambda text: first_number(text, "nan")), "another form"),
        (preintegration_message(lambda text: first_number(text, "1.0e+999")), "has 'inf', expected finite values up to 1e+06"),
        (
            preintegration_message(lambda text: first_number(text, "-1.0e+00")),
            "gyroscope covariance that is not positive definite",
        ),
        (preintegration_message(lambda text: first_number(text, "1.0e+300")), "has '1e+300', expected finite values"),
        (preintegration_message(lambda text: text.replace("-9.81", "-1.81", 1)), "gravity of '1.81"),
        (
            preintegration_message(lambda text: text.replace(" 1.00000000000000006e-01", " 5.0e+02", 1)),
            "has the bias '[500.0, 0.2",
        ),
        (preintegration_message(lambda text: last_number(text, "-1.0e-09")), "a covariance that is not positive definite"),
        (
            preintegration_message(lambda text: last_number(text, "1.0e+03", place=-3)),
            "covariance of nothing, or one that is not",
        ),
        (preintegration_message(inflate=0.5), "inflate '0.5'"),
        (preintegration_message(inflate=float("nan")), "field 'inflate' has 'nan'"),
        (preintegration_message(from_sec=5), "spans '0.3"),
        (preintegration_message(from_sec=2**32 - 1), "spans '0.3"),
    ],
)
def test_a_preintegration_that_is_not_safe_never_reaches_gtsam(message: PointCloud2, complaint: str) -> None:
    with pytest.raises(MessageError) as caught:
        messages.preintegration_from_message(message)
    assert complaint in str(caught.value)


def test_imu_messages_without_the_data_or_with_nan_are_refused() -> None:
    message = deserialize_message(messages.imu_to_cdr(ImuSample(STAMP_NS, np.zeros(3), np.zeros(3))), Imu)
    assert message.orientation_covariance[0] == -1.0
    message.angular_velocity_covariance[0] = -1.0
    with pytest.raises(MessageError, match="no angular rate"):
        messages.imu_from_message(message)
    message.angular_velocity_covariance[0] = 0.0
    message.linear_acceleration.x = float("nan")
    with pytest.raises(MessageError, match="expected finite"):
        messages.imu_from_message(message)


@pytest.mark.parametrize("stamp_ns", [-1, 2**31 * 10**9])
def test_a_stamp_that_ros_cannot_hold_is_refused(stamp_ns: int) -> None:
    with pytest.raises(MessageError, match=f"stamp is '{stamp_ns}'"):
        messages.to_time(stamp_ns)


@pytest.mark.parametrize("frame", ["", "x: y", ": reset", "-1: reset", "٣: reset", "9" * 300])
def test_a_session_without_a_number_is_refused(frame: str) -> None:
    with pytest.raises(MessageError, match="expected 'N: reason'"):
        messages.session_from_message(Header(frame_id=frame))


# Fuzzing

READERS: list[Callable[[PointCloud2], Any]] = [
    *dict.fromkeys(read for _, _, read in CLOUDS.values()),
    messages.preintegration_from_message,
]


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(list(CLOUDS)), st.data())
def test_any_change_to_a_cloud_is_read_or_refused_but_never_worse(name: str, data: st.DataObject) -> None:
    message = broken(name)
    numbers = st.sampled_from([0, 1, 3, 4, 2**16, 2**31, 2**32 - 1]) | st.integers(0, 2**32 - 1)
    for key in data.draw(st.lists(st.sampled_from(["width", "height", "point_step", "row_step"]), max_size=2)):
        setattr(message, key, data.draw(numbers))
    item = data.draw(st.sampled_from(message.fields))
    item.offset, item.count = data.draw(numbers | st.just(item.offset)), data.draw(numbers | st.just(item.count))
    item.datatype = data.draw(st.integers(0, 255) | st.just(item.datatype))
    for _ in range(data.draw(st.integers(0, 3))):
        message.data[data.draw(st.integers(0, len(message.data) - 1))] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        message.data = message.data[: data.draw(st.integers(0, len(message.data)))]
    for read in READERS:
        try:
            read(message)
        except MessageError:
            continue


@settings(max_examples=100, deadline=None)
@given(
    st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1), st.text(max_size=8), st.binary(max_size=64)
)
def test_any_image_is_read_or_refused_but_never_worse(width: int, height: int, step: int, encoding: str, data: bytes) -> None:
    encoding = encoding.replace("\0", "")
    raw = ImageMessage(width=width, height=height, step=step, encoding=encoding, data=array.array("B", data))
    for message in (raw, CompressedImage(format=encoding, data=array.array("B", data))):
        try:
            messages.encoded_from_message(message)
            messages.image_from_message(raw)
        except MessageError:
            continue
