"""The graph for a scanner that is there: `ros2 launch vli_bringup vli.launch.py calibration:=C [config:=F] [mode:=M]`."""

from launch import LaunchDescription
from vli_bringup.launching import launch_graph


def generate_launch_description() -> LaunchDescription:
    """Return the five nodes; the driver publishes the calibration and plays nothing."""
    return launch_graph(with_bag=False)
