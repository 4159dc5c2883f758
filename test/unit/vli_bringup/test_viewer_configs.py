"""The configurations for RViz and Foxglove against the topics as the nodes publish them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from vli_common.topics import MAP_FRAME, NAMESPACE, TOPICS, Topic

TYPES = {
    "rviz_default_plugins/PointCloud2": "sensor_msgs/msg/PointCloud2",
    "rviz_default_plugins/Path": "nav_msgs/msg/Path",
    "rviz_default_plugins/Pose": "geometry_msgs/msg/PoseStamped",
    "rviz_default_plugins/Odometry": "nav_msgs/msg/Odometry",
    "rviz_default_plugins/Image": "sensor_msgs/msg/Image",
}
"""Display of RViz → what it shows."""
PANELS = {
    "DiagnosticSummary": "diagnostic_msgs/msg/DiagnosticArray",
    "Plot": "nav_msgs/msg/Odometry",
    "Image": "sensor_msgs/msg/Image",
}
SHOWN = {"map", "map_update", "cloud", "path", "pose", "odometry", "image_long", "image_short", "laser_points"}


def published() -> dict[str, Topic]:
    """Return the topics by the names that a viewer finds them under."""
    return {topic.name if topic.name.startswith("/") else f"/{NAMESPACE}/{topic.name}": topic for topic in TOPICS}


@pytest.fixture(scope="module")
def rviz(repository: Path) -> dict[str, Any]:
    document: dict[str, Any] = yaml.safe_load((repository / "config/rviz/vli.rviz").read_text())
    return document["Visualization Manager"]


@pytest.fixture(scope="module")
def foxglove(repository: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((repository / "config/foxglove/vli.json").read_text())
    return document


def displays(rviz: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the displays that have a topic, by its name."""
    return {display["Topic"]["Value"]: display for display in rviz["Displays"] if "Topic" in display}


def test_rviz_shows_topics_of_the_table_as_what_they_are(rviz: dict[str, Any]) -> None:
    found = displays(rviz)
    assert {published()[name].name for name in found} == SHOWN
    assert {name: TYPES[display["Class"]] for name, display in found.items()} == {name: published()[name].type for name in found}


def test_rviz_asks_for_no_more_than_the_nodes_offer_and_gets_the_map_when_it_comes_late(rviz: dict[str, Any]) -> None:
    for name, display in displays(rviz).items():
        topic, asked = published()[name], display["Topic"]
        assert asked["Reliability Policy"] == "Reliable"
        assert asked["Durability Policy"] == ("Transient Local" if topic.transient_local else "Volatile"), name
        assert asked["Depth"] == topic.depth, name


def test_clouds_with_colour_are_shown_in_it_and_in_their_own_frame(rviz: dict[str, Any]) -> None:
    assert rviz["Global Options"]["Fixed Frame"] == MAP_FRAME
    for name, display in displays(rviz).items():
        fields = published()[name].fields
        if fields is not None:
            assert (display["Color Transformer"] == "RGB8") == ("rgb" in (fields.names or ())), name


def foxglove_topics(document: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield panel type and topic."""
    for panel, config in document["configById"].items():
        kind = panel.partition("!")[0]
        yield from ((kind, name) for name in config.get("topics", {}))
        if kind == "Image":
            yield kind, config["imageMode"]["imageTopic"]
        if "topicToRender" in config:
            yield kind, config["topicToRender"]
        yield from ((kind, re.split(r"[.\[]", path["value"])[0]) for path in config.get("paths", []))


def test_foxglove_shows_topics_of_the_table_in_panels_that_can(foxglove: dict[str, Any]) -> None:
    found = list(foxglove_topics(foxglove))
    assert {published()[name].name for _, name in found} == SHOWN | {"/diagnostics"}
    for kind, name in found:
        if kind == "3D":
            assert published()[name].type in TYPES.values()
        else:
            assert published()[name].type == PANELS[kind], name


def test_every_panel_of_foxglove_has_its_place_in_the_layout(foxglove: dict[str, Any]) -> None:
    def leaves(item: Any) -> Iterator[str]:
        if isinstance(item, str):
            yield item
        else:
            yield from leaves(item["first"])
            yield from leaves(item["second"])

    assert sorted(leaves(foxglove["layout"])) == sorted(foxglove["configById"])


def test_the_configurations_are_installed_for_ros(repository: Path) -> None:
    setup = (repository / "src/vli_bringup/setup.py").read_text()
    for name in ("rviz", "foxglove"):
        assert f'("share/vli_bringup/{name}", glob("vli_bringup/data/config/{name}/*"))' in setup
        assert list((repository / "src/vli_bringup/vli_bringup/data/config" / name).iterdir())
