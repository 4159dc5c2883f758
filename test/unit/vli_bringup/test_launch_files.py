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

from vli_bringup.cli import make_parser
from vli_bringup.graph import Playback, describe_graph
from vli_common.topics import TOPICS
from vli_common.types import Mode


@dataclass
class Recorded:
    """Any action or substitution of launch: keeps what it was made with."""

    arguments: tuple[Any, ...]
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def returncode(self) -> int:
        return int(self.options["returncode"])

    def perform(self, context: dict[str, str]) -> str:
        return context[self.arguments[0]]


@pytest.fixture(autouse=True)
def launch(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    names = {
        "launch": ("LaunchContext", "LaunchDescription"),
        "launch.actions": ("DeclareLaunchArgument", "ExecuteProcess", "LogInfo", "OpaqueFunction", "RegisterEventHandler"),
        "launch.event_handlers": ("OnProcessExit",),
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
    expected = describe_graph(Path("c.yaml"), Mode.VI, None, Playback(Path("b"), 0.5), Path("map.ply"), 30.0)
    got = [(item.options["package"], item.options["executable"], item.options["parameters"]) for item in nodes]
    assert got == [(node.package, node.executable, ["vli.yaml", dict(node.parameters)]) for node in expected]


def test_without_a_bag_the_driver_plays_nothing(repository: Path) -> None:
    driver, *stages = started(repository, "live.launch.py", calibration="c.yaml")
    assert set(driver.options["parameters"][0]) == {"mode", "calibration_file"}
    assert [item.options["executable"] for item in stages] == ["demux_node", "frontend_node", "backend_node", "mapping_node"]
    assert {item.options["namespace"] for item in [driver, *stages]} == {"vli"}
    assert all(item.options["remappings"] == [] for item in [driver, *stages])


def test_the_topics_of_a_sensor_have_the_names_that_are_given(repository: Path) -> None:
    names = {"image_topic": "/cam/image/compressed", "imu_topic": "/cam/imu"}
    _, demux, frontend, *_ = started(repository, "live.launch.py", calibration="c.yaml", **names)
    assert demux.options["parameters"][-1]["image_topic"] == "/cam/image"
    assert demux.options["parameters"][-1]["exposure_topic"] == "/camera/exposure"
    assert frontend.options["parameters"][-1]["imu_topic"] == "/cam/imu"


def test_two_scanners_share_no_topic_but_diagnostics(repository: Path) -> None:
    (node, *_) = started(repository, "live.launch.py", calibration="c.yaml", namespace="left")
    renamed = dict(node.options["remappings"])
    absolute = {topic.name for topic in TOPICS if topic.name.startswith("/")}
    assert set(renamed) == absolute - {"/diagnostics"}
    assert renamed["/tf"] == "tf"
    assert renamed["/camera/image_raw"] == "camera/image_raw"


def test_rviz_is_started_with_the_configuration_that_is_shipped_and_sees_the_scanner_it_is_started_for(repository: Path) -> None:
    assert len(started(repository, "live.launch.py", calibration="c.yaml")) == 5
    *_, rviz = started(repository, "live.launch.py", calibration="c.yaml", rviz="true", namespace="left")
    assert (rviz.options["package"], rviz.options["executable"]) == ("rviz2", "rviz2")
    option, path = rviz.options["arguments"]
    assert option == "-d"
    assert Path(path).samefile(repository / "config/rviz/vli.rviz")
    assert dict(rviz.options["remappings"])["/vli/map"] == "map"


def test_a_simulation_is_replayed_once_it_is_made(repository: Path) -> None:
    simulator, handler = started(repository, "simulate.launch.py", out="scene", scene="pipe", seed="3", rate="0.5")
    assert simulator.options["cmd"][1:] == [
        *("-m", "vli_bringup.cli", "simulate", "pipe", "--out", "scene", "--preset", "smoke", "--seed", "3"),
    ]
    (on_exit,) = handler.arguments
    assert on_exit.options["target_action"] is simulator
    driver, *stages = on_exit.options["on_exit"](Recorded((), {"returncode": 0}), None)
    expected = describe_graph(
        Path("scene/calibration.yaml"), playback=Playback(Path("scene/bag"), 0.5), save_path=Path("map.ply"), autosave_s=30.0
    )
    assert driver.options["parameters"] == [dict(expected[0].parameters)]
    assert len(stages) == 4
    (told,) = on_exit.options["on_exit"](Recorded((), {"returncode": 2}), None)
    assert "ended with code 2" in told.options["msg"]


def test_the_simulator_understands_what_the_launch_file_asks_of_it(repository: Path, tmp_path: Path) -> None:
    simulator, _ = started(repository, "simulate.launch.py", out=str(tmp_path))
    arguments = make_parser("simulate").parse_args(simulator.options["cmd"][3:])
    assert (arguments.out, arguments.preset, arguments.seed) == (tmp_path, "smoke", 0)


def test_every_executable_of_the_graph_is_installed_by_its_package(repository: Path) -> None:
    for node in describe_graph(Path("c.yaml")):
        setup = (repository / "src" / node.package / "setup.py").read_text()
        assert f'"{node.executable} = {node.module}:main"' in setup
        assert f'"vli_{node.executable} = {node.module}:main"' in setup
