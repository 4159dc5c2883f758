"""One description of a parameter serves the file, the command line and the node."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import pytest
import yaml

from vli_common.config import from_mapping, parameter, parameters, section, to_mapping, to_yaml_lines
from vli_common.errors import ConfigError


@dataclass(frozen=True)
class Inner:
    """A nested one."""

    level: float = parameter(1e-05, unit="m", minimum=0.0, maximum=1.0, doc="how far")
    kind: str = parameter("a", choices=("a", "b"), doc="which")


@dataclass(frozen=True)
class Outer:
    """The outer one."""

    count: int = parameter(3, unit="points", minimum=1, doc="how many")
    enabled: bool = parameter(True, doc="whether")
    inner: Inner = section(Inner)


def test_missing_names_keep_their_defaults_and_nested_or_dotted_is_the_same() -> None:
    assert from_mapping(Outer, {}) == Outer()
    expected = dataclasses.replace(Outer(), inner=Inner(level=0.5))
    assert from_mapping(Outer, {"inner": {"level": 0.5}}) == from_mapping(Outer, {"inner.level": 0.5}) == expected


def test_a_whole_number_does_for_a_float_but_nothing_else_is_converted() -> None:
    assert isinstance(from_mapping(Outer, {"inner.level": 1}).inner.level, float)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("count", 0, "'count' is '0', expected at least 1 points"),
        ("count", 2.5, "'count' is '2.5', expected an integer"),
        ("count", True, "'count' is 'True', expected an integer"),
        ("enabled", 1, "'enabled' is '1', expected true or false"),
        ("inner.level", 1.5, "'inner.level' is '1.5', expected 0.0 to 1.0 m"),
        ("inner.level", float("nan"), "expected a finite number"),
        ("inner.level", True, "expected a number"),
        ("inner.level", None, "expected a number"),
        ("inner.kind", "c", "'inner.kind' is 'c', expected one of a, b"),
        ("inner.levle", 0.1, "unknown parameter 'inner.levle', did you mean 'inner.level'?"),
    ],
)
def test_a_wrong_value_or_name_says_what_would_be_valid(name: str, value: object, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        from_mapping(Outer, {name: value})
    assert message in str(caught.value)


def test_all_problems_come_at_once() -> None:
    with pytest.raises(ConfigError) as caught:
        from_mapping(Outer, {"count": 0, "inner": {"level": -1, "nothing": 2}})
    assert len(caught.value.problems) == 3


def test_the_commented_yaml_of_a_config_reads_back_as_that_config() -> None:
    config = Outer(7, False, Inner(2.5e-07, "b"))
    text = "\n".join(to_yaml_lines(config))
    assert from_mapping(Outer, yaml.safe_load(text)) == config
    assert "# how far; 0.0 to 1.0 m" in text
    assert yaml.safe_load(yaml.safe_dump(to_mapping(config))) == to_mapping(config)


def test_every_parameter_has_a_meaning() -> None:
    assert [spec.name for spec in parameters(Outer)] == ["count", "enabled", "inner.level", "inner.kind"]
    assert all(spec.doc for spec in parameters(Outer))
