"""Config dataclasses as ROS parameters: declared with range and meaning, checked at start and at run time."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, ParameterType, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from vli_common.config import ParameterSpec, from_mapping, parameter, parameters, unknown_key
from vli_common.errors import ConfigError
from vli_common.types import Mode

T = TypeVar("T")

_TYPES = {
    bool: ParameterType.PARAMETER_BOOL,
    int: ParameterType.PARAMETER_INTEGER,
    float: ParameterType.PARAMETER_DOUBLE,
    str: ParameterType.PARAMETER_STRING,
}
_INT_LIMIT = 2**62
_FLOAT_LIMIT = 1e308
_ROS_OWN = ("use_sim_time", "start_type_description_service", "qos_overrides")


@dataclass(frozen=True)
class NodeConfig:
    """Parameters that every node has."""

    mode: str = parameter(
        "vli-slam", choices=tuple(mode.value for mode in Mode), doc="which sensors take part; the same for all nodes"
    )
    calibration_file: str = parameter("", doc="calibration; empty: from the topic 'calibration'")
    imu_calibration_file: str = parameter("", doc="Kalibr's separate IMU file, where imu0 is not in the calibration")
    autostart: bool = parameter(True, doc="configure and activate at start; false: wait for a lifecycle manager")


def descriptor(spec: ParameterSpec, read_only: bool = False) -> ParameterDescriptor:
    """Return what ROS tools show of a parameter: meaning, unit, range."""
    unit = f" [{spec.unit}]" if spec.unit else ""
    # A whole number is a fine value of a float: dynamic typing lets '3' pass for '3.0', the check below is ours.
    message = ParameterDescriptor(
        name=spec.name,
        type=_TYPES[spec.kind],
        description=spec.doc + unit,
        read_only=read_only,
        dynamic_typing=spec.kind is float,
    )
    if spec.choices:
        message.additional_constraints = f"one of {', '.join(spec.choices)}"
    low, high = spec.minimum, spec.maximum
    if spec.kind is int and (low, high) != (None, None):
        bounds = (-_INT_LIMIT if low is None else int(low), _INT_LIMIT if high is None else int(high))
        message.integer_range = [IntegerRange(from_value=bounds[0], to_value=bounds[1], step=1)]
    elif spec.kind is float and (low, high) != (None, None):
        limits = (-_FLOAT_LIMIT if low is None else float(low), _FLOAT_LIMIT if high is None else float(high))
        message.floating_point_range = [FloatingPointRange(from_value=limits[0], to_value=limits[1], step=0.0)]
    return message


class NodeParameters:
    """The parameters of one node, as config dataclasses.

    Args:
        node: that declares them.
        configs: config dataclass → prefix of its parameters (``"stripe"``, or ``""``).
        fixed: those of ``configs`` that the node reads once, when it starts: to set them later is refused.

    Raises:
        ConfigError: unknown names and invalid values among the overrides, all at once.
    """

    def __init__(self, node: Node, configs: Mapping[type, str], fixed: Collection[type] = ()) -> None:
        self._node = node
        self._configs: dict[type, str] = {**configs, NodeConfig: ""}
        self.changed = False
        """True where a stage parameter was set since the stage was made; it takes effect with the next session."""
        specs = {
            config_type: [replace(spec, name=_dotted(prefix, spec.name)) for spec in parameters(config_type)]
            for config_type, prefix in self._configs.items()
        }
        self._specs = {spec.name: spec for group in specs.values() for spec in group}
        self._check_overrides()
        for config_type, group in specs.items():
            for spec in group:
                node.declare_parameter(spec.name, spec.default, descriptor(spec, config_type in (NodeConfig, *fixed)))
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._note)

    def config(self, config_type: type[T]) -> T:
        """Return a config of this type with the values of now."""
        prefix = self._configs[config_type]
        names = [spec.name for spec in parameters(config_type)]
        return from_mapping(config_type, {name: self._node.get_parameter(_dotted(prefix, name)).value for name in names})

    def _check_overrides(self) -> None:
        """Raise for every override that is wrong; rclpy would pass over unknown names and stop at the first bad value."""
        overrides: dict[str, Parameter] = self._node._parameter_overrides
        problems = [
            unknown_key(name, self._specs) for name in overrides if name not in self._specs and not name.startswith(_ROS_OWN)
        ]
        problems += self._problems(item for name, item in overrides.items() if name in self._specs)
        if problems:
            raise ConfigError([f"{self._node.get_name()}: {problem}" for problem in problems])

    def _problems(self, items: Iterable[Parameter]) -> list[str]:
        found = (self._specs[item.name].problem(item.value) for item in items if item.name in self._specs)
        return [problem for problem in found if problem]

    def _check(self, items: list[Parameter]) -> SetParametersResult:
        problems = self._problems(items)
        return SetParametersResult(successful=not problems, reason="; ".join(problems))

    def _note(self, items: list[Parameter]) -> None:
        self.changed = self.changed or any(item.name in self._specs for item in items)


def _dotted(prefix: str, name: str) -> str:
    return f"{prefix}.{name}" if prefix else name
