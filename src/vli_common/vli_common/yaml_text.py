"""YAML from files, topics and the command line, none of which is to be trusted: plain values only, of a bounded size.

An alias costs nothing to read and may stand for any amount of text: nine lines of nine aliases each are a billion values once
they are written out. What a document would come to is counted before any of it is made.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import yaml

from vli_common.errors import InputError

MAX_CHARACTERS = 2**18
"""A calibration with the records of all its commands has some 20,000."""
MAX_VALUES = 50_000
MAX_DIGITS = 64
"""Of an integer. Python refuses to write one of more than 4300, however it was read."""

_INTEGER = "tag:yaml.org,2002:int"


class _Loader(yaml.SafeLoader):
    """YAML 1.1 reads 1e-3 as a string; ROS reads it as a number, and so does this."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def load_yaml(text: str) -> Any:
    """Return the one document of a text, None where it is empty.

    Raises:
        InputError: it is not YAML, holds more than plain values, or is too large; says where.
    """
    if len(text) > MAX_CHARACTERS:
        raise InputError(f"has '{len(text)}' characters, expected at most {MAX_CHARACTERS}")
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        _check_size(node)
        return loader.construct_document(node)
    except (yaml.YAMLError, RecursionError, ValueError, OverflowError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        raise InputError(f"is not YAML{where}: {getattr(error, 'problem', None) or type(error).__name__}") from error


def parse_assignments(assignments: Iterable[str], example: str) -> tuple[dict[str, Any], list[str]]:
    """Return the values of ``--set KEY=VALUE`` by key, each read as YAML, and a line for each that cannot be.

    Args:
        assignments: as they stand on the command line.
        example: for the lines.
    """
    values: dict[str, Any] = {}
    problems: list[str] = []
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals or not name.strip():
            problems.append(f"'--set {assignment}', expected --set KEY=VALUE, e.g. --set {example}")
            continue
        try:
            values[name.strip()] = load_yaml(text)
        except InputError as error:
            problems.append(f"'--set {assignment}' {error}")
    return values, problems


def _check_size(root: yaml.Node) -> None:
    """Raise where the tree, with every alias written out, has more than ``MAX_VALUES`` nodes; a loop has no end of them."""
    waiting, count = [root], 0
    while waiting:
        node = waiting.pop()
        count += 1
        if count > MAX_VALUES:
            raise InputError(f"holds more than '{MAX_VALUES}' values, expected fewer, and no alias within itself")
        if isinstance(node, yaml.ScalarNode) and node.tag == _INTEGER and len(node.value) > MAX_DIGITS:
            raise InputError(f"holds an integer of '{len(node.value)}' digits, expected at most {MAX_DIGITS}")
        if isinstance(node, yaml.MappingNode):
            waiting += [part for pair in node.value for part in pair]
        elif isinstance(node, yaml.SequenceNode):
            waiting += node.value
