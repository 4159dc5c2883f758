"""The node graph, described once: `vli replay` and the launch files start the same processes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vli_common.topics import DIAGNOSTICS, NAMESPACE, TOPICS
from vli_common.types import Mode
from vli_driver.config import DriverConfig


@dataclass(frozen=True, slots=True)
class NodeDescription:
    """One process of the graph.

    Args:
        package, executable: as ``ros2 run`` names them.
        parameters: those beyond the parameter file.
        respawn: whether it is started again when it crashes. Not what plays a bag: it would begin anew.
    """

    package: str
    executable: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    respawn: bool = True

    @property
    def module(self) -> str:
        """Python module of the executable."""
        return f"{self.package}.nodes.{self.executable}"


@dataclass(frozen=True, slots=True)
class Playback:
    """Which part of a bag the driver plays, and how fast."""

    bag: Path
    rate: float = 1.0
    start_s: float = 0.0
    duration_s: float | None = None


AUTOSAVE, AUTOSAVE_S = "autosave.vli", 30.0
"""Name of mapping's automatic saves, beside where it saves when it is told to; how often the commands ask for one."""

SCANNER = "driver_node"
STAGES = (
    ("vli_driver", "demux_node"),
    ("vli_frontend", "frontend_node"),
    ("vli_backend", "backend_node"),
    ("vli_mapping", "mapping_node"),
)
"""Package and executable of every node behind the source, in the order of the data."""

NODE_ONLY = frozenset(
    {
        *("mode", "calibration_file", "imu_calibration_file", "autostart"),
        *("bag", "rate", "loop", "start", "duration", "wait_for", "wait_timeout"),
        *("image_topic", "exposure_topic", "imu_topic"),
        *("save_path", "load_path", "export_path", "autosave_s", "autosave_path", "reload_autosave"),
    }
)
"""Parameters of nodes that are no parameter of a stage; a parameter file may hold them, and only the nodes mind them."""


def describe_graph(
    calibration: Path,
    mode: Mode = Mode.VLI_SLAM,
    imu_calibration: Path | None = None,
    playback: Playback | None = None,
    save_path: Path | None = None,
    autosave_s: float = 0.0,
    audience: str | None = None,
    sensor: DriverConfig | None = None,
) -> list[NodeDescription]:
    """Return every node of the graph.

    Args:
        calibration: file that the driver publishes for all.
        mode: which sensors take part.
        imu_calibration: Kalibr's separate IMU file.
        playback: the bag to play; None for a graph that waits for a camera and an IMU.
        save_path: where mapping saves the map.
        autosave_s: how often it saves it beside that by itself, to go on with after a crash; 0: never.
        audience: a node outside the graph that the playback waits for as well.
        sensor: topics of a camera and an IMU that are there; what plays a bag publishes under the names of the table.
    """
    shared: dict[str, Any] = {"mode": mode.value}
    source = {**shared, "calibration_file": str(calibration.absolute())}
    if imu_calibration is not None:
        source["imu_calibration_file"] = str(imu_calibration.absolute())
    if playback is not None:
        awaited = [executable for _, executable in STAGES]
        source |= {
            "bag": str(playback.bag.absolute()),
            "rate": playback.rate,
            "start": playback.start_s,
            "duration": playback.duration_s or 0.0,
            "wait_for": ",".join([*awaited, audience] if audience else awaited),
        }
    own: dict[str, dict[str, Any]] = {"mapping_node": _saves(save_path.absolute(), autosave_s)} if save_path else {}
    if sensor is not None and playback is None:
        image = sensor.image_topic.removesuffix("/compressed")
        own |= {
            "demux_node": {"image_topic": image, "exposure_topic": sensor.exposure_topic},
            "frontend_node": {"imu_topic": sensor.imu_topic},
        }
    nodes = [NodeDescription("vli_driver", SCANNER, source, respawn=playback is None)]
    return nodes + [NodeDescription(package, name, {**shared, **own.get(name, {})}) for package, name in STAGES]


def _saves(path: Path, autosave_s: float) -> dict[str, Any]:
    automatic = {"autosave_s": autosave_s, "autosave_path": str(path.with_name(AUTOSAVE))} if autosave_s else {}
    return {"save_path": str(path), **automatic}


def remappings(namespace: str) -> list[tuple[str, str]]:
    """Return name → name for every node of one scanner among several: what is absolute becomes its own.

    Args:
        namespace: of the nodes; nothing is renamed in the default one.
    """
    absolute = [topic.name for topic in TOPICS if topic.name.startswith("/") and topic is not DIAGNOSTICS]
    return [] if namespace == NAMESPACE else [(name, name.removeprefix("/")) for name in absolute]


def viewer_remappings(namespace: str) -> list[tuple[str, str]]:
    """Return the same for a viewer that knows the topics by the names of the default namespace."""
    if namespace == NAMESPACE:
        return []
    relative = [topic.name for topic in TOPICS if not topic.name.startswith("/")]
    return [*remappings(namespace), *((f"/{NAMESPACE}/{name}", name) for name in relative)]
