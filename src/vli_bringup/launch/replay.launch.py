"""The graph with a bag: `ros2 launch vli_bringup replay.launch.py bag:=BAG calibration:=C [rate:=R] [rviz:=true]`."""

from launch import LaunchDescription
from vli_bringup.launching import launch_replay


def generate_launch_description() -> LaunchDescription:
    """Return the five nodes; the driver plays the bag once all are ready."""
    return launch_replay()
