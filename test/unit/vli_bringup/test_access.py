"""The policy for SROS 2 allows each node what it does, and nothing else."""

from __future__ import annotations

import time
from xml.etree import ElementTree

import pytest
import rclpy

from vli_backend.nodes.backend_node import BackEndNode
from vli_bringup import access
from vli_driver.nodes.demux_node import DemuxNode
from vli_driver.nodes.driver_node import DriverNode
from vli_frontend.nodes.frontend_node import FrontEndNode
from vli_mapping.nodes.mapping_node import MappingNode

NODES = {
    "driver_node": DriverNode, "demux_node": DemuxNode, "frontend_node": FrontEndNode, "backend_node": BackEndNode,
    "mapping_node": MappingNode,
}  # fmt: skip
WITHOUT_TF2 = {"/tf", "/tf_static"}
"""Published only where tf2_msgs is installed."""
HEARD_OF_S = 60.0
"""The graph hears of what a node has opened in time."""
CLOCK = {"/clock"}
"""Heard only with use_sim_time."""


@pytest.fixture(scope="module")
def nodes():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        rclpy.init(args=[])
        made = {name: kind() for name, kind in NODES.items()}
        yield made
        for node in made.values():
            node.destroy_node()
        rclpy.try_shutdown()


def test_the_file_in_config_is_the_one_that_make_config_writes(repository):
    assert (repository / "config" / "sros2" / "vli.policy.xml").read_text() == access.policy()


def test_the_policy_has_an_enclave_for_every_node():
    root = ElementTree.fromstring(access.policy())
    assert {item.get("path") for item in root.iter("enclave")} == {f"/vli/{name}" for name in NODES}
    assert {item.get("node") for item in root.iter("profile")} == set(NODES) == set(access.NODES)


def opened(node, name):
    """Return the topics that a node of the graph publishes and hears, and the services it answers, as the graph knows of now."""
    published = {topic for topic, _ in node.get_publisher_names_and_types_by_node(name, "/vli")}
    heard = {topic for topic, _ in node.get_subscriber_names_and_types_by_node(name, "/vli")}
    answered = {service for service, _ in node.get_service_names_and_types_by_node(name, "/vli")}
    return published - WITHOUT_TF2, heard | CLOCK, answered


@pytest.mark.parametrize("name", sorted(NODES))
def test_a_node_opens_what_the_policy_allows_it_and_nothing_else(nodes, name):
    allowed = set(access.published(name)) - WITHOUT_TF2, set(access.heard(name)), set(access.answered(name))
    deadline_s = time.monotonic() + HEARD_OF_S
    while (found := opened(nodes[name], name)) != allowed and time.monotonic() < deadline_s:
        time.sleep(0.1)
    assert found == allowed
