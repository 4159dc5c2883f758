"""Stage configurations: frozen dataclasses whose fields know their unit, range and meaning.

One description serves the YAML file, ``--set stage.key=value`` and the ROS parameters. A stage writes::

    @dataclass(frozen=True)
    class StripeConfig:
        min_points: int = parameter(20, unit="points", minimum=1, doc="shorter stripes are dropped: less noise, fewer far points")
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import math
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, TypeVar

from vli_common.errors import ConfigError

T = TypeVar("T")

_LARGEST = 2**1023
"""An integer beyond has no float."""


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """Description of one parameter; ``name`` is dotted where configs are nested."""

    name: str
    kind: type[Any]
    default: Any
    unit: str
    minimum: float | None
    maximum: float | None
    choices: tuple[str, ...]
    doc: str

    def problem(self, value: Any) -> str | None:
        """Return what is wrong with ``value``, or None."""
        wanted = {float: "a number", int: "an integer", bool: "true or false", str: "a string"}[self.kind]
        if self.kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value) if abs(value) < _LARGEST else math.inf
        if not isinstance(value, self.kind) or (self.kind is int and isinstance(value, bool)):
            return f"'{self.name}' is '{value}', expected {wanted}"
        if isinstance(value, float) and not math.isfinite(value):
            return f"'{self.name}' is '{value}', expected a finite number"
        if self.choices and value not in self.choices:
            return f"'{self.name}' is '{value}', expected one of {', '.join(self.choices)}"
        if (self.minimum is not None and value < self.minimum) or (self.maximum is not None and value > self.maximum):
            return f"'{self.name}' is '{value}', expected {self._range()}"
        return None

    def _range(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if self.minimum is None:
            return f"at most {self.maximum}{unit}"
        if self.maximum is None:
            return f"at least {self.minimum}{unit}"
        return f"{self.minimum} to {self.maximum}{unit}"


def parameter(
    default: Any,
    *,
    doc: str,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """Return a dataclass field that carries its unit, valid range (inclusive) and meaning."""
    metadata = {"doc": doc, "unit": unit, "minimum": minimum, "maximum": maximum, "choices": choices}
    return dataclasses.field(default=default, metadata=metadata)


def section(factory: type[T]) -> T:
    """Return a dataclass field that holds a nested config."""
    return dataclasses.field(default_factory=factory)


def parameters(config_type: type, prefix: str = "") -> Iterator[ParameterSpec]:
    """Yield every parameter of a config dataclass, nested ones with dotted names."""
    hints = _hints(typing.cast(Any, config_type))
    for item in dataclasses.fields(config_type):
        kind = hints[item.name]
        if dataclasses.is_dataclass(kind):
            yield from parameters(typing.cast(type, kind), f"{prefix}{item.name}.")
            continue
        meta = item.metadata
        default = item.default.value if isinstance(item.default, Enum) else item.default
        yield ParameterSpec(
            prefix + item.name, kind, default, meta["unit"], meta["minimum"], meta["maximum"], meta["choices"], meta["doc"]
        )


def flatten(mapping: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested mappings as one with dotted names."""
    flat: dict[str, Any] = {}
    for key, value in mapping.items():
        if isinstance(value, Mapping):
            flat.update(flatten(value, f"{prefix}{key}."))
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def from_mapping(config_type: type[T], mapping: Mapping[str, Any], problems: Sequence[str] = ()) -> T:
    """Build a config from (nested or dotted) names; missing ones keep their defaults.

    Args:
        config_type: the dataclass.
        mapping: names and values.
        problems: that were found while reading them, to be told with those found here.

    Raises:
        ConfigError: unknown names (with the nearest valid one) and invalid values, all at once.
    """
    specs = {spec.name: spec for spec in parameters(config_type)}
    flat = flatten(mapping)
    problems = [*problems, *(unknown_key(name, specs) for name in flat if name not in specs)]
    for name, value in flat.items():
        if name in specs and (problem := specs[name].problem(value)):
            problems.append(problem)
    if problems:
        raise ConfigError(problems)
    return _build(config_type, flat, "")


def unknown_key(name: str, known: Mapping[str, Any]) -> str:
    """Return the sentence for an unknown key, with the nearest valid one."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.0)
    return f"unknown parameter '{name}'" + (f", did you mean '{near[0]}'?" if near else "")


def to_mapping(config: Any) -> dict[str, Any]:
    """Return a config as nested plain values, ready for YAML."""
    return {
        item.name: to_mapping(value) if dataclasses.is_dataclass(value := getattr(config, item.name)) else value
        for item in dataclasses.fields(config)
    }


def to_yaml_lines(config: Any, indent: int = 0) -> list[str]:
    """Return a config as commented YAML: each parameter with its meaning, unit and range."""
    pad = " " * indent
    lines: list[str] = []
    specs = {spec.name: spec for spec in parameters(type(config))}
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            lines += [f"{pad}{item.name}:", *to_yaml_lines(value, indent + 2)]
            continue
        spec = specs[item.name]
        limits = (
            ", ".join(spec.choices)
            if spec.choices
            else spec._range()
            if spec.minimum is not None or spec.maximum is not None
            else ""
        )
        notes = "; ".join(part for part in (spec.doc, limits or spec.unit) if part)
        lines += [f"{pad}# {notes}", f"{pad}{item.name}: {_yaml_scalar(value)}"]
    return lines


def _yaml_scalar(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, float):
        text = repr(value)
        # YAML 1.1 reads 1e-05 as a string: a float needs a dot.
        return text.replace("e", ".0e") if "e" in text and "." not in text else text
    return str(value)


def _build(config_type: type[T], flat: Mapping[str, Any], prefix: str) -> T:
    hints = _hints(typing.cast(Any, config_type))
    values: dict[str, Any] = {}
    for item in dataclasses.fields(typing.cast(Any, config_type)):
        kind, name = hints[item.name], prefix + item.name
        if dataclasses.is_dataclass(kind):
            values[item.name] = _build(typing.cast(type, kind), flat, f"{name}.")
        elif name in flat:
            values[item.name] = float(flat[name]) if kind is float else flat[name]
    return config_type(**values)


@functools.cache
def _hints(config_type: type) -> dict[str, Any]:
    """Return the types of the fields, which are written as text: a node asks for its config several times a second."""
    return typing.get_type_hints(config_type)
