"""What the launch files have in common. Needs ROS 2's ``launch`` and ``launch_ros``, which pip does not have."""

from __future__ import annotations

from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription  # type: ignore[attr-defined]  # mypy finds our directory of that name
from vli_bringup.graph import Playback, describe_graph
from vli_bringup.processes import MAX_RESTARTS
from vli_common.node import set_transport_profile
from vli_common.types import Mode

_ARGUMENTS = {
    "calibration": "calibration file",
    "imu_calibration": "Kalibr's separate IMU file, where the calibration has no imu0",
    "config": "parameters of all nodes, in the form of config/vli.yaml",
    "mode": f"one of {', '.join(mode.value for mode in Mode)}",
    "save_path": "where mapping's ~/save writes the map",
    "respawn": "true: a node that ends is started again, three times at most; what plays a bag is not",
}
_PLAYBACK = {"bag": "rosbag2 directory or bare .mcap", "rate": "bag seconds a second"}
_DEFAULTS = {
    "imu_calibration": "",
    "config": "",
    "mode": Mode.VLI_SLAM.value,
    "save_path": "map.ply",
    "respawn": "true",
    "rate": "1.0",
}


def launch_graph(with_bag: bool) -> LaunchDescription:
    """Return the launch description of the graph, with a bag to play or without."""
    arguments = {**_ARGUMENTS, **(_PLAYBACK if with_bag else {})}

    def start(context: LaunchContext) -> list[Node]:
        return _nodes({name: LaunchConfiguration(name).perform(context) for name in arguments})

    declared = [
        DeclareLaunchArgument(name, description=text, default_value=_DEFAULTS.get(name)) for name, text in arguments.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])


def _nodes(values: dict[str, str]) -> list[Node]:
    set_transport_profile()
    imu = Path(values["imu_calibration"]) if values["imu_calibration"] else None
    playback = Playback(Path(values["bag"]), float(values["rate"])) if "bag" in values else None
    graph = describe_graph(Path(values["calibration"]), Mode(values["mode"]), imu, playback, Path(values["save_path"]))
    files = [values["config"]] if values["config"] else []
    respawn = values["respawn"].lower() in ("true", "1", "yes")
    return [
        Node(
            package=node.package,
            executable=node.executable,
            parameters=[*files, dict(node.parameters)],
            output="screen",
            respawn=respawn and node.respawn,
            respawn_max_retries=MAX_RESTARTS,
        )
        for node in graph
    ]
