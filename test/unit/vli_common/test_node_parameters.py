"""Config dataclasses as ROS parameters: ranges are shown, bad values refused with the reason, the old ones kept."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pytest
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter

from vli_common.config import parameter, section
from vli_common.errors import ConfigError
from vli_common.node.parameters import NodeConfig, NodeParameters


@dataclass(frozen=True)
class Inner:
    """A nested one."""

    level: float = parameter(0.5, unit="m", minimum=0.0, maximum=1.0, doc="how far")


@dataclass(frozen=True)
class Outer:
    """The outer one."""

    count: int = parameter(3, minimum=1, doc="how many")
    kind: str = parameter("a", choices=("a", "b"), doc="which")
    inner: Inner = section(Inner)


@pytest.fixture(scope="module", autouse=True)
def context() -> Iterator[None]:
    rclpy.init(args=[])
    yield
    rclpy.try_shutdown()


def node_with(**overrides: object) -> Node:
    values = [Parameter(name.replace("__", "."), value=value) for name, value in overrides.items()]
    return rclpy.create_node("parameters", parameter_overrides=values, start_parameter_services=False)


def test_values_of_the_parameter_file_reach_the_config() -> None:
    node = node_with(stripe__count=7, stripe__inner__level=1, mode="vi")
    held = NodeParameters(node, {Outer: "stripe"})
    assert held.config(Outer) == Outer(count=7, inner=Inner(level=1.0))
    assert held.config(NodeConfig).mode == "vi"
    assert not held.changed


def test_ros_tools_see_meaning_unit_and_range() -> None:
    node = node_with()
    NodeParameters(node, {Outer: ""})
    level = node.describe_parameter("inner.level")
    assert level.description == "how far [m]"
    assert (level.floating_point_range[0].from_value, level.floating_point_range[0].to_value) == (0.0, 1.0)
    assert node.describe_parameter("count").integer_range[0].from_value == 1
    assert node.describe_parameter("kind").additional_constraints == "one of a, b"
    assert node.describe_parameter("calibration_file").read_only


def test_all_wrong_overrides_are_told_at_once_with_the_nearest_valid_name() -> None:
    with pytest.raises(ConfigError) as caught:
        NodeParameters(node_with(cuont=3, count=0, kind="c", use_sim_time=True), {Outer: ""})
    assert len(caught.value.problems) == 3
    assert "parameters: unknown parameter 'cuont', did you mean 'count'?" in caught.value.problems
    assert "parameters: 'kind' is 'c', expected one of a, b" in caught.value.problems


@pytest.mark.parametrize(("name", "value"), [("inner.level", 1.5), ("count", 0), ("kind", "c"), ("mode", "vi"), ("count", 2.5)])
def test_a_bad_value_at_run_time_is_refused_and_the_old_one_kept(name: str, value: object) -> None:
    node = node_with()
    held = NodeParameters(node, {Outer: ""})
    (result,) = node.set_parameters([Parameter(name, value=value)])
    assert not result.successful
    assert result.reason
    assert held.config(Outer) == Outer()
    assert not held.changed


def test_a_good_value_at_run_time_is_taken_and_noted() -> None:
    node = node_with()
    held = NodeParameters(node, {Outer: ""})
    (result,) = node.set_parameters([Parameter("inner.level", value=0.25)])
    assert result.successful
    assert held.config(Outer).inner.level == 0.25
    assert held.changed


def test_what_a_node_reads_once_cannot_be_set_later() -> None:
    node = node_with(stripe__count=5)
    held = NodeParameters(node, {Outer: "stripe"}, fixed=[Outer])
    (result,) = node.set_parameters([Parameter("stripe.count", value=7)])
    assert not result.successful
    assert "read-only" in result.reason
    assert held.config(Outer).count == 5
    assert node.describe_parameter("stripe.inner.level").read_only
