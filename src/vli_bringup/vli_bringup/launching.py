"""What the launch files have in common. Needs ROS 2's ``launch`` and ``launch_ros``, which pip does not have."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from launch.actions import DeclareLaunchArgument, ExecuteProcess, LogInfo, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription  # type: ignore[attr-defined]  # mypy finds our directory of that name
from vli_bringup.graph import AUTOSAVE, AUTOSAVE_S, Playback, describe_graph, remappings, viewer_remappings
from vli_bringup.processes import MAX_RESTARTS
from vli_common.node import set_transport_profile
from vli_common.topics import NAMESPACE
from vli_common.types import Mode
from vli_driver.config import DriverConfig

RVIZ_CONFIG = Path(__file__).parent / "data" / "config" / "rviz" / "vli.rviz"
_TRUE = ("true", "1", "yes")

_Arguments = Mapping[str, tuple[str, str | None]]
"""Name → what it is, and its default; None: it must be given."""
_CALIBRATION: _Arguments = {
    "calibration": ("calibration file", None),
    "imu_calibration": ("Kalibr's separate IMU file, where the calibration has no imu0", ""),
}
_COMMON: _Arguments = {
    "config": ("parameters of all nodes, in the form of config/vli.yaml", ""),
    "mode": (f"one of {', '.join(mode.value for mode in Mode)}", Mode.VLI_SLAM.value),
    "namespace": (
        "of all nodes; another one for each scanner: its camera, IMU and transforms are looked for there too",
        NAMESPACE,
    ),
    "save_path": ("where mapping's ~/save writes the map", "map.ply"),
    "autosave": (f"seconds between automatic saves of all of it, {AUTOSAVE} beside save_path; 0: never", f"{AUTOSAVE_S:g}"),
    "respawn": ("true: a node that ends is started again, three times at most; what plays a bag is not", "true"),
    "rviz": ("true: RViz as well, as it is set up for these topics", "false"),
}
_PLAYBACK: _Arguments = {
    "bag": ("rosbag2 directory or bare .mcap", None),
    "rate": ("bag seconds a second", "1.0"),
}
_SENSOR: _Arguments = {
    name: (f"{text}; NAME/compressed is heard as well" if name == "image_topic" else text, getattr(DriverConfig(), name))
    for name, text in (("image_topic", "of the camera"), ("imu_topic", "of the IMU"), ("exposure_topic", "optional"))
}
_SIMULATION: _Arguments = {
    "scene": ("what to scan: keyboard, pipe or part", "keyboard"),
    "out": ("directory for bag, calibration and truth; must not exist", None),
    "preset": ("smoke (5 s), short (25 s) or full", "smoke"),
    "seed": ("of everything that is random", "0"),
    "rate": _PLAYBACK["rate"],
}


def launch_live() -> LaunchDescription:
    """Return the launch description of the graph for a scanner that is there."""
    return _description({**_CALIBRATION, **_COMMON, **_SENSOR}, _nodes)


def launch_replay() -> LaunchDescription:
    """Return the launch description of the graph with a bag."""
    return _description({**_CALIBRATION, **_COMMON, **_PLAYBACK}, _nodes)


def launch_simulation() -> LaunchDescription:
    """Return the launch description of the simulator, and then the graph with what it has made."""
    return _description({**_SIMULATION, **_COMMON}, _simulate)


def _description(arguments: _Arguments, actions: Callable[[dict[str, str]], list[Any]]) -> LaunchDescription:
    def start(context: LaunchContext) -> list[Any]:
        return actions({name: LaunchConfiguration(name).perform(context) for name in arguments})

    declared = [
        DeclareLaunchArgument(name, description=text, default_value=default) for name, (text, default) in arguments.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])


def _simulate(values: dict[str, str]) -> list[Any]:
    out = Path(values["out"])
    options = ["--out", str(out), "--preset", values["preset"], "--seed", values["seed"]]
    simulator = ExecuteProcess(
        cmd=[sys.executable, "-m", "vli_bringup.cli", "simulate", values["scene"], *options], output="screen"
    )
    made = {"calibration": str(out / "calibration.yaml"), "imu_calibration": "", "bag": str(out / "bag")}

    def follow(event: Any, _: LaunchContext) -> list[Any]:
        if event.returncode:
            return [LogInfo(msg=f"the simulator ended with code {event.returncode}: there is nothing to replay")]
        return _nodes({**values, **made})

    return [simulator, RegisterEventHandler(OnProcessExit(target_action=simulator, on_exit=follow))]


def _nodes(values: dict[str, str]) -> list[Node]:
    set_transport_profile()
    imu = Path(values["imu_calibration"]) if values["imu_calibration"] else None
    playback = Playback(Path(values["bag"]), float(values["rate"])) if "bag" in values else None
    names: dict[str, Any] = {name: values[name] for name in _SENSOR if name in values}
    sensor = replace(DriverConfig(), **names) if names else None
    graph = describe_graph(
        Path(values["calibration"]),
        Mode(values["mode"]),
        imu,
        playback,
        Path(values["save_path"]),
        float(values["autosave"]),
        sensor=sensor,
    )
    files = [values["config"]] if values["config"] else []
    namespace, respawn = values["namespace"], values["respawn"].lower() in _TRUE
    nodes = [
        Node(
            package=node.package,
            executable=node.executable,
            namespace=namespace,
            parameters=[*files, dict(node.parameters)],
            remappings=remappings(namespace),
            output="screen",
            respawn=respawn and node.respawn,
            respawn_max_retries=MAX_RESTARTS,
        )
        for node in graph
    ]
    return [*nodes, _viewer(namespace)] if values["rviz"].lower() in _TRUE else nodes


def _viewer(namespace: str) -> Node:
    return Node(
        package="rviz2",
        executable="rviz2",
        name="rviz",
        namespace=namespace,
        arguments=["-d", str(RVIZ_CONFIG)],
        remappings=viewer_remappings(namespace),
        output="log",
    )
