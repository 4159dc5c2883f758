"""For a scanner that is there: `ros2 launch vli_bringup live.launch.py calibration:=C [image_topic:=/x] [rviz:=true]`."""

from launch import LaunchDescription
from vli_bringup.launching import launch_live


def generate_launch_description() -> LaunchDescription:
    """Return the five nodes; the driver publishes the calibration and plays nothing."""
    return launch_live()
