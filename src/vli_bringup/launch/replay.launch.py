"""The graph with a bag: `ros2 launch vli_bringup replay.launch.py bag:=BAG calibration:=C [rate:=R] [config:=F] [mode:=M]`."""

from launch import LaunchDescription
from vli_bringup.launching import launch_graph


def generate_launch_description() -> LaunchDescription:
    """Return the five nodes; the driver plays the bag once all are ready."""
    return launch_graph(with_bag=True)
