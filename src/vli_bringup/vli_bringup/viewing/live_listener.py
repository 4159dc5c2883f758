"""The topics of a running graph, to a display."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor

from vli_bringup.viewing.live import LiveDisplay
from vli_common.arrays import FloatArray
from vli_common.calibration import parse_calibration
from vli_common.errors import CalibrationError, MessageError
from vli_common.geometry import inverse
from vli_common.messages import cloud_from_message, path_from_message, pose_from_message, status_from_message
from vli_common.node.transport import message_type, quality, set_transport_profile
from vli_common.topics import CALIBRATION, CLOUD, MAP, MAP_UPDATE, NAMESPACE, PATH, POSE, STATUS, Topic
from vli_common.types import Counters

T = TypeVar("T")
_POSE_PERIOD_S = 0.1
"""A browser need not redraw the camera at the rate of the frames."""


class LiveListener:
    """Joins the graph and hands on what comes; use as a context manager.

    Args:
        display: gets clouds, path, pose and states.
    """

    def __init__(self, display: LiveDisplay) -> None:
        self.counters = Counters()
        self._display = display
        self._T_imu_camera: FloatArray = np.eye(4)
        self._posed_s = 0.0

    def __enter__(self) -> LiveListener:
        """Join the graph."""
        set_transport_profile()
        rclpy.init(signal_handler_options=rclpy.SignalHandlerOptions.NO)
        self._node = rclpy.create_node("view", namespace=NAMESPACE)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._subscribe(MAP, cloud_from_message, self._display.add_map)
        self._subscribe(MAP_UPDATE, cloud_from_message, self._display.add_update)
        self._subscribe(CLOUD, cloud_from_message, self._display.add_stripes)
        self._subscribe(PATH, path_from_message, self._on_path)
        self._subscribe(POSE, pose_from_message, self._on_pose)
        self._subscribe(STATUS, status_from_message, self._display.add_status)
        self._subscribe(CALIBRATION, lambda message: parse_calibration(message.data, None).T_cam_imu, self._on_calibration)
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the graph."""
        self._executor.shutdown(timeout_sec=0)
        self._node.destroy_node()
        rclpy.try_shutdown()

    def spin(self, seconds: float) -> None:
        """Handle what comes for some seconds."""
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            self._executor.spin_once(left_s)

    def _subscribe(self, topic: Topic, read: Callable[[Any], T], handle: Callable[[T], None]) -> None:
        """Hand on what can be read, count the rest."""

        def take(message: Any) -> None:
            try:
                value = read(message)
            except (MessageError, CalibrationError):
                self.counters.add(f"{topic.name}_malformed")
                return
            handle(value)

        self._node.create_subscription(message_type(topic), topic.name, take, quality(topic, reading=True))

    def _on_path(self, poses: list[tuple[int, FloatArray]]) -> None:
        self._display.add_path(np.array([T_map_imu for _, T_map_imu in poses]).reshape(-1, 4, 4))

    def _on_pose(self, pose: tuple[int, FloatArray]) -> None:
        if time.monotonic() >= self._posed_s + _POSE_PERIOD_S:
            self._posed_s = time.monotonic()
            self._display.add_pose(pose[1] @ self._T_imu_camera)

    def _on_calibration(self, T_cam_imu: FloatArray | None) -> None:
        self._T_imu_camera = np.eye(4) if T_cam_imu is None else inverse(T_cam_imu)
