"""The workspace builds with colcon, and every node starts from what was installed and stops cleanly."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
import rclpy

pytestmark = pytest.mark.graph

PACKAGES = [
    "vli_backend",
    "vli_bringup",
    "vli_calibration",
    "vli_common",
    "vli_driver",
    "vli_frontend",
    "vli_mapping",
    "vli_simulation",
]
NODES = {
    "driver_node": "vli_driver",
    "demux_node": "vli_driver",
    "frontend_node": "vli_frontend",
    "backend_node": "vli_backend",
    "mapping_node": "vli_mapping",
}
START_TIMEOUT_S = 120.0
STOP_TIMEOUT_S = 20.0


@dataclass(frozen=True)
class Workspace:
    """A colcon workspace that was built: sources, install space and the environment that ``install/setup.bash`` makes."""

    source: Path
    install: Path
    environment: dict[str, str]


def colcon(directory: Path, *arguments: object) -> str:
    """Run colcon of this interpreter in a directory of its own; return what it printed."""
    command = [sys.executable, "-m", "colcon", "--log-base", str(directory / "log"), *map(str, arguments)]
    result = subprocess.run(command, cwd=directory, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def workspace(tmp_path_factory, repository):
    root = tmp_path_factory.mktemp("workspace")
    ignore = shutil.ignore_patterns("__pycache__", "*.egg-info", "build")
    # Links are followed: the package data of vli_bringup are links to the top of the repository.
    shutil.copytree(repository / "src", root / "src", ignore=ignore)
    colcon(root, "build", "--base-paths", "src")
    script = f'source "{root}/install/setup.bash" && env -0'
    raw = subprocess.run(["bash", "-c", script], capture_output=True, check=True, text=True).stdout
    environment = dict(item.split("=", 1) for item in raw.split("\0") if "=" in item)
    return Workspace(root / "src", root / "install", environment)


def test_colcon_takes_every_package_as_ament_python(workspace, tmp_path):
    listed = colcon(tmp_path, "list", "--base-paths", workspace.source).split("\n")
    assert [line.split("\t")[0] for line in listed if line] == PACKAGES
    assert all(line.endswith("(ros.ament_python)") for line in listed if line)


def test_the_packages_are_found_in_the_ament_index_and_imported_from_the_install_space(workspace):
    for package in PACKAGES:
        assert (workspace.install / package / "share/ament_index/resource_index/packages" / package).is_file()
    code = f"import importlib; print(*[importlib.import_module(name).__file__ for name in {PACKAGES}], sep='\\n')"
    result = subprocess.run([sys.executable, "-c", code], env=workspace.environment, capture_output=True, text=True, check=True)
    assert [Path(line).is_relative_to(workspace.install) for line in result.stdout.split()] == [True] * len(PACKAGES)


def test_configuration_and_launch_files_are_installed(workspace):
    share = workspace.install / "vli_bringup" / "share" / "vli_bringup"
    assert (share / "config" / "vli.yaml").is_file()
    assert list((share / "launch").glob("*.launch.py"))


@pytest.fixture(scope="module")
def watcher():
    """Return a node to see the others with."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("watcher", context=context)
    yield node
    node.destroy_node()
    context.shutdown()


@pytest.mark.parametrize("name", NODES)
def test_a_node_starts_from_the_install_space_and_stops_on_sigint_with_exit_code_0(workspace, watcher, name):
    executable = workspace.install / NODES[name] / "lib" / NODES[name] / name
    environment = {**workspace.environment, "ROS_DOMAIN_ID": os.environ["ROS_DOMAIN_ID"]}
    process = subprocess.Popen([executable], env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        deadline = time.monotonic() + START_TIMEOUT_S
        while name not in watcher.get_node_names() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
        assert name in watcher.get_node_names()
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=STOP_TIMEOUT_S)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0, output
    assert "Traceback" not in output
