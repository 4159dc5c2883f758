"""What is written beside a simulated bag, and the bag itself, in the formats of docs: rosbag2 (mcap), TUM, PLY, JSON, YAML."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from vli_common.arrays import AnyArray, FloatArray
from vli_common.geometry import quaternion_from_rotation
from vli_common.types import NANOSECONDS, ImuSample
from vli_simulation.config import ImuConfig
from vli_simulation.imu import ImuRecording
from vli_simulation.rig import Rig
from vli_simulation.sensor import EncodedFrame

CAMERA_FRAME, IMU_FRAME = "camera_optical_frame", "imu_link"
_UNKNOWN_ORIENTATION = np.array([-1.0, *[0.0] * 8])
_BLOCK = 16384


class BagWriter:
    """Writes the recording's messages; a context manager. Messages are to come in the order of their stamps."""

    def __init__(
        self, path: Path, rig: Rig, imu: ImuConfig, compressed: bool, exposure_topic: bool, with_camera: bool = True
    ) -> None:
        self._with_camera = with_camera
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        if not with_camera:
            # Images are compressed already; IMU messages are covariances and other repetition for the most part.
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._rig, self._compressed, self._exposure_topic = rig, compressed, exposure_topic
        variance = np.array([imu.gyroscope_noise_density, imu.accelerometer_noise_density]) ** 2 * imu.rate_hz
        self._gyro_covariance, self._accel_covariance = (np.diag([value] * 3).ravel() for value in variance)
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> BagWriter:
        """Open the bag and declare its topics."""
        self._writer.open()
        image = ("/camera/image_raw/compressed", "CompressedImage") if self._compressed else ("/camera/image_raw", "Image")
        camera = [
            ("image", image[0], f"sensor_msgs/msg/{image[1]}"),
            ("info", "/camera/camera_info", "sensor_msgs/msg/CameraInfo"),
        ]
        for name, topic, kind in (
            *(camera if self._with_camera else []),
            ("imu", "/imu", "sensor_msgs/msg/Imu"),
            *([("exposure", "/camera/exposure", "diagnostic_msgs/msg/DiagnosticArray")] if self._exposure_topic else []),
        ):
            self._connections[name] = self._writer.add_connection(topic, kind, typestore=self._store)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._writer.close()

    def add_imu(self, sample: ImuSample) -> None:
        """Write one IMU sample."""
        self._write("imu", sample.stamp_ns, self._imu_message(sample))

    def add_imu_recording(self, recording: ImuRecording, progress: Callable[[int], object] | None = None) -> None:
        """Write a whole recording: the same bytes as :meth:`add_imu`, but faster: only numbers are filled in."""
        connection, kind = self._connections["imu"], self._imu_layout()
        still = ImuSample(0, np.zeros(3), np.zeros(3))
        template = bytes(self._store.serialize_cdr(self._imu_message(still), connection.msgtype))
        for first in range(0, len(recording.stamps_ns), _BLOCK):
            block = slice(first, first + _BLOCK)
            stamps = recording.stamps_ns[block]
            rows = np.frombuffer(bytearray(template * len(stamps)), kind)
            rows["sec"], rows["nanosec"] = stamps // NANOSECONDS, stamps % NANOSECONDS
            rows["gyro"], rows["accel"] = recording.gyro[block], recording.accel[block]
            data, size = memoryview(rows.tobytes()), kind.itemsize
            for index, stamp in enumerate(stamps.tolist()):
                self._writer.write(connection, stamp, data[index * size : (index + 1) * size])
            if progress:
                progress(len(stamps))

    def _imu_layout(self) -> np.dtype[np.void]:
        """Return where the numbers of a serialised Imu stand: after a header of 4 bytes, doubles are aligned to 8."""
        text_end = 12 + len(IMU_FRAME) + 1
        orientation = 4 + -(-text_end // 8) * 8
        gyro = orientation + 8 * (4 + 9)
        accel = gyro + 8 * (3 + 9)
        return np.dtype(
            {
                "names": ["sec", "nanosec", "gyro", "accel"],
                "formats": ["i4", "u4", ("f8", 3), ("f8", 3)],
                "offsets": [4, 8, gyro, accel],
                "itemsize": accel + 8 * (3 + 9),
            }
        )

    def _imu_message(self, sample: ImuSample) -> object:
        make = self._store.types
        vector, quaternion = make["geometry_msgs/msg/Vector3"], make["geometry_msgs/msg/Quaternion"]
        return make["sensor_msgs/msg/Imu"](
            header=self._header(sample.stamp_ns, IMU_FRAME),
            orientation=quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=_UNKNOWN_ORIENTATION,
            angular_velocity=vector(*(float(value) for value in sample.gyro)),
            angular_velocity_covariance=self._gyro_covariance,
            linear_acceleration=vector(*(float(value) for value in sample.accel)),
            linear_acceleration_covariance=self._accel_covariance,
        )

    def add_frame(self, stamp_ns: int, frame: EncodedFrame, exposure_s: float, laser_on: bool) -> None:
        """Write one frame with its camera info and, where asked for, its exposure."""
        header = self._header(stamp_ns, CAMERA_FRAME)
        data = np.frombuffer(frame.data, np.uint8)
        if frame.compressed:
            message = self._store.types["sensor_msgs/msg/CompressedImage"](header=header, format=frame.encoding, data=data)
        else:
            camera = self._rig.camera
            message = self._store.types["sensor_msgs/msg/Image"](
                header=header,
                height=camera.height,
                width=camera.width,
                encoding=frame.encoding,
                is_bigendian=0,
                step=frame.step,
                data=data,
            )
        if self._exposure_topic:
            self._add_exposure(stamp_ns, exposure_s, laser_on)
        self._write("image", stamp_ns, message)
        self._add_info(stamp_ns)

    def _add_info(self, stamp_ns: int) -> None:
        camera = self._rig.camera
        lens = self._rig.document["cam0"]["distortion_model"]
        plumb_bob = np.zeros(5)
        plumb_bob[: len(camera.coefficients)] = camera.coefficients
        types = self._store.types
        message = types["sensor_msgs/msg/CameraInfo"](
            header=self._header(stamp_ns, CAMERA_FRAME),
            height=camera.height,
            width=camera.width,
            distortion_model="equidistant" if lens == "equidistant" else "plumb_bob",
            d=np.array(camera.coefficients) if lens == "equidistant" else plumb_bob,
            k=camera.matrix.ravel(),
            r=np.eye(3).ravel(),
            p=np.hstack([camera.matrix, np.zeros((3, 1))]).ravel(),
            binning_x=0,
            binning_y=0,
            roi=types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
        )
        self._write("info", stamp_ns, message)

    def _add_exposure(self, stamp_ns: int, exposure_s: float, laser_on: bool) -> None:
        types = self._store.types
        pair, status = types["diagnostic_msgs/msg/KeyValue"], types["diagnostic_msgs/msg/DiagnosticStatus"]
        values = [pair(key="exposure_s", value=repr(exposure_s)), pair(key="laser", value="on" if laser_on else "off")]
        entry = status(level=0, name="camera", message="", hardware_id="simulation", values=values)
        message = types["diagnostic_msgs/msg/DiagnosticArray"](header=self._header(stamp_ns, CAMERA_FRAME), status=[entry])
        self._write("exposure", stamp_ns, message)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        types = self._store.types
        stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // NANOSECONDS, nanosec=stamp_ns % NANOSECONDS)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)

    def _write(self, name: str, stamp_ns: int, message: object) -> None:
        connection = self._connections[name]
        self._writer.write(connection, stamp_ns, self._store.serialize_cdr(message, connection.msgtype))


def write_tum(path: Path, stamps_ns: Iterable[int], poses: FloatArray) -> None:
    """Write poses (N, 4, 4) as ``t x y z qx qy qz qw``; stamps are printed from integers."""
    quaternions = quaternion_from_rotation(poses[:, :3, :3])
    with path.open("w") as file:
        for stamp, position, q in zip(stamps_ns, poses[:, :3, 3], quaternions, strict=True):
            values = " ".join(f"{value:.9f}" for value in (*position, *q))
            file.write(f"{stamp // NANOSECONDS}.{stamp % NANOSECONDS:09d} {values}\n")


def write_passes(path: Path, length_m: float, passes: list[tuple[float, float]]) -> None:
    """Write the length of the path and the start and end of each pass, seconds."""
    path.write_text(json.dumps({"length_m": length_m, "passes": [list(bounds) for bounds in passes]}, indent=1) + "\n")


def write_ply(path: Path, comment: str, vertices: AnyArray, faces: AnyArray | None = None) -> None:
    """Write a binary PLY.

    Args:
        path: of the file.
        comment: one line for its header.
        vertices: (N,) structured array; its fields become properties.
        faces: (F, 3) vertex indices, or None for a point cloud.
    """
    names = {"f4": "float", "f8": "double", "u1": "uchar"}
    little_endian = vertices.astype(vertices.dtype.newbyteorder("<"))
    lines = ["ply", "format binary_little_endian 1.0", f"comment {comment}", f"element vertex {len(vertices)}"]
    for name in vertices.dtype.names or ():
        lines.append(f"property {names[vertices.dtype[name].str[1:]]} {name}")
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar uint vertex_indices"]
    with path.open("wb") as file:
        file.write(("\n".join([*lines, "end_header"]) + "\n").encode())
        file.write(little_endian.tobytes())
        if faces is not None:
            records = np.empty(len(faces), [("count", "u1"), ("index", "<u4", 3)])
            records["count"], records["index"] = 3, faces
            file.write(records.tobytes())
