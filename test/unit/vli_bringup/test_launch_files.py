"""The launch files start the same processes as ``vli replay``. ROS 2's launch is stood in for: pip does not have it."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from vli_bringup.graph import Playback, describe_graph
from vli_common.types import Mode


@dataclass
class Recorded:
    """Any action or substitution of launch: keeps what it was made with."""

    arguments: tuple[Any, ...]
    options: dict[str, Any] = field(default_factory=dict)

    def perform(self, context: dict[str, str]) -> str:
        return context[self.arguments[0]]


@pytest.fixture(autouse=True)
def launch(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    names = {
        "launch": ("LaunchContext", "LaunchDescription"),
        "launch.actions": ("DeclareLaunchArgument", "OpaqueFunction"),
        "launch.substitutions": ("LaunchConfiguration",),
        "launch_ros": (),
        "launch_ros.actions": ("Node",),
    }
    for module_name, attributes in names.items():
        module = ModuleType(module_name)
        for attribute in attributes:
            setattr(module, attribute, lambda *arguments, **options: Recorded(arguments, options))
        monkeypatch.setitem(sys.modules, module_name, module)
    monkeypatch.delitem(sys.modules, "vli_bringup.launching", raising=False)
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "set")
    yield
    sys.modules.pop("vli_bringup.launching", None)


def started(repository: Path, name: str, **given: str) -> list[Recorded]:
    """Return the nodes that a launch file starts with these arguments."""
    path = repository / "src" / "vli_bringup" / "launch" / name
    spec = importlib.util.spec_from_file_location("launch_file", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    *declared, function = module.generate_launch_description().arguments[0]
    values = {item.arguments[0]: item.options["default_value"] for item in declared} | given
    assert None not in values.values(), "an argument without a default is given"
    nodes: list[Recorded] = function.options["function"](values)
    return nodes


def test_replay_starts_what_vli_replay_starts(repository: Path) -> None:
    nodes = started(repository, "replay.launch.py", bag="b", calibration="c.yaml", rate="0.5", mode="vi", config="vli.yaml")
    expected = describe_graph(Path("c.yaml"), Mode.VI, None, Playback(Path("b"), 0.5), Path("map.ply"))
    got = [(item.options["package"], item.options["executable"], item.options["parameters"]) for item in nodes]
    assert got == [(node.package, node.executable, ["vli.yaml", dict(node.parameters)]) for node in expected]


def test_without_a_bag_the_driver_plays_nothing(repository: Path) -> None:
    driver, *stages = started(repository, "vli.launch.py", calibration="c.yaml")
    assert set(driver.options["parameters"][0]) == {"mode", "calibration_file"}
    assert [item.options["executable"] for item in stages] == ["demux_node", "frontend_node", "backend_node", "mapping_node"]


def test_every_executable_of_the_graph_is_installed_by_its_package(repository: Path) -> None:
    for node in describe_graph(Path("c.yaml")):
        setup = (repository / "src" / node.package / "setup.py").read_text()
        assert f'"{node.executable} = {node.module}:main"' in setup
        assert f'"vli_{node.executable} = {node.module}:main"' in setup
