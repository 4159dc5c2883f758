"""The parameters of all stages together: ``config/vli.yaml``, ``--config`` and ``--set``.

The file has the form of a ROS 2 parameter file, so that nodes and ``vli run`` read the same one.
``python -m vli_bringup.settings`` writes it with every default.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vli_backend.config import BackEndConfig
from vli_bringup.graph import NODE_ONLY
from vli_common.config import flatten, from_mapping, parameters, section, to_yaml_lines, unknown_key
from vli_common.errors import ConfigError, InputError
from vli_common.yaml_text import load_yaml, parse_assignments
from vli_driver.config import DemuxConfig, DriverConfig, StripeConfig
from vli_frontend.config import FrontEndConfig
from vli_mapping.config import MappingConfig

_PARAMETERS = "ros__parameters"
NODES: dict[str, tuple[str, ...]] = {
    "driver_node": ("driver",),
    "demux_node": ("demux", "stripe"),
    "frontend_node": ("frontend",),
    "backend_node": ("backend",),
    "mapping_node": ("mapping",),
}
"""Node → the stages whose parameters it holds; a node of one stage holds them without the stage's name."""

_HEADING = """\
# Every parameter with its default. Nodes take this file by `--ros-args --params-file`, `vli run` and `vli replay` by `--config`;
# a file may hold only what it changes. Written by `make config` from the config.py of each package.
"""


@dataclass(frozen=True)
class Settings:
    """Parameters of every stage."""

    driver: DriverConfig = section(DriverConfig)
    demux: DemuxConfig = section(DemuxConfig)
    stripe: StripeConfig = section(StripeConfig)
    frontend: FrontEndConfig = section(FrontEndConfig)
    backend: BackEndConfig = section(BackEndConfig)
    mapping: MappingConfig = section(MappingConfig)


def load_settings(path: Path | None = None, assignments: Iterable[str] = ()) -> Settings:
    """Return the defaults, changed by a parameter file and by assignments ``stage.key=value``, in this order.

    Raises:
        ConfigError: the file cannot be read, or names or values are wrong; all problems at once.
    """
    values = _read(path) if path else {}
    assigned, problems = parse_assignments(assignments, "frontend.max_features=150")
    return from_mapping(Settings, values | assigned, problems)


def to_yaml(settings: Settings) -> str:
    """Return the settings as a ROS 2 parameter file in which every parameter is explained."""
    lines = [_HEADING]
    for node, stages in NODES.items():
        lines += [f"/**/{node}:", f"  {_PARAMETERS}:"]
        for stage in stages:
            config = getattr(settings, stage)
            nested = len(stages) > 1
            lines += [f"    {stage}:", *to_yaml_lines(config, 6)] if nested else to_yaml_lines(config, 4)
        lines.append("")
    return "\n".join(lines)


def _read(path: Path) -> dict[str, Any]:
    """Return the parameters of a file by dotted names ``stage.key``."""
    try:
        document = load_yaml(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError([f"parameter file '{path}' cannot be read ({error}), expected one like config/vli.yaml"]) from error
    except InputError as error:
        raise ConfigError([f"parameter file '{path}' {error}"]) from error
    if not isinstance(document, Mapping):
        raise ConfigError([f"parameter file '{path}' holds '{str(document)[:60]}', expected sections like '/**/frontend_node:'"])
    values: dict[str, Any] = {}
    for name, content in document.items():
        values.update(_node_parameters(str(name), content))
    return values


def _node_parameters(name: str, content: Any) -> dict[str, Any]:
    """Return the parameters of one node's section by dotted names ``stage.key``."""
    node = name.rsplit("/", 1)[-1]
    if node not in NODES:
        raise ConfigError([unknown_key(name, {f"/**/{known}": None for known in NODES}).replace("parameter", "section")])
    if not isinstance(content, Mapping) or set(content) != {_PARAMETERS} or not isinstance(content[_PARAMETERS] or {}, Mapping):
        raise ConfigError([f"section '{name}', expected one key '{_PARAMETERS}:' with the parameters below it"])
    stages = NODES[node]
    prefix = f"{stages[0]}." if len(stages) == 1 else ""
    known = {spec.name for spec in parameters(Settings)}
    flat = flatten(content[_PARAMETERS] or {}, prefix)
    return {key: value for key, value in flat.items() if key in known or key.removeprefix(prefix) not in NODE_ONLY}


if __name__ == "__main__":
    sys.stdout.write(to_yaml(Settings()))
