"""A simulated scan, then its replay: `ros2 launch vli_bringup simulate.launch.py scene:=keyboard out:=DIR [rviz:=true]`."""

from launch import LaunchDescription
from vli_bringup.launching import launch_simulation


def generate_launch_description() -> LaunchDescription:
    """Return the simulator, and the five nodes once it has written its bag."""
    return launch_simulation()
