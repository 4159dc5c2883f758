"""Which node may publish, hear and answer what, as a policy for SROS 2; from the table of topics.

``python -m vli_bringup.access`` writes ``config/sros2/vli.policy.xml``.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from xml.etree import ElementTree

from vli_bringup.graph import SCANNER, STAGES
from vli_common.topics import CALIBRATION, NAMESPACE, SESSION, STATUS, TOPICS

NODES = (SCANNER, *(executable for _, executable in STAGES))

SERVICES: dict[str, tuple[str, ...]] = {"mapping_node": ("save", "load", "export", "clear")}
"""Node → services beside those that every node has."""

_EVERY_NODE = {
    "publish": ("parameter_events", "rosout", "~/transition_event"),
    "subscribe": ("clock",),
    "reply": (
        *("~/reset", "~/pause", "~/resume"),
        *("~/change_state", "~/get_state", "~/get_available_states", "~/get_available_transitions", "~/get_transition_graph"),
        *("~/describe_parameters", "~/get_parameter_types", "~/get_parameters", "~/list_parameters"),
        *("~/set_parameters", "~/set_parameters_atomically", "~/get_type_description"),
    ),
}
"""What :class:`vli_common.node.VliNode` and rclpy open in each; names without ``~`` are of the root."""

_HEARD_BY_ALL = (CALIBRATION, SESSION, STATUS)

_HEADING = """\
<?xml version="1.0" encoding="UTF-8"?>
<!-- Who may publish, hear and answer what; an enclave each. Written by `make config` from the table of topics. Those of the
     scanner that are renamed by a parameter (image_topic, imu_topic, exposure_topic) must be renamed here as well. -->
"""


def published(node: str) -> list[str]:
    """Return the topics that a node publishes, by full name."""
    return _names(node, _EVERY_NODE["publish"], (topic.name for topic in TOPICS if node in topic.sources))


def heard(node: str) -> list[str]:
    """Return the topics that a node subscribes to, by full name."""
    mine = (topic.name for topic in TOPICS if node in topic.targets or topic in _HEARD_BY_ALL)
    return _names(node, _EVERY_NODE["subscribe"], mine)


def answered(node: str) -> list[str]:
    """Return the services that a node offers, by full name."""
    return _names(node, _EVERY_NODE["reply"], (f"~/{name}" for name in SERVICES.get(node, ())))


def policy() -> str:
    """Return the policy of the graph, in the form that ``ros2 security create_permission`` reads."""
    root = ElementTree.Element("policy", version="0.2.0")
    enclaves = ElementTree.SubElement(root, "enclaves")
    for node in NODES:
        enclave = ElementTree.SubElement(enclaves, "enclave", path=f"/{NAMESPACE}/{node}")
        profile = ElementTree.SubElement(ElementTree.SubElement(enclave, "profiles"), "profile", ns=f"/{NAMESPACE}", node=node)
        for kind, action, names in (
            ("topic", "publish", published(node)),
            ("topic", "subscribe", heard(node)),
            ("service", "reply", answered(node)),
        ):
            allowed = ElementTree.SubElement(profile, f"{kind}s", {action: "ALLOW"})
            for name in names:
                ElementTree.SubElement(allowed, kind).text = name
    ElementTree.indent(root)
    return _HEADING + ElementTree.tostring(root, "unicode") + "\n"


def _names(node: str, common: Iterable[str], own: Iterable[str]) -> list[str]:
    return sorted({*(_full(node, name, "") for name in common), *(_full(node, name, f"/{NAMESPACE}") for name in own)})


def _full(node: str, name: str, namespace: str) -> str:
    if name.startswith("~"):
        return f"/{NAMESPACE}/{node}{name[1:]}"
    return name if name.startswith("/") else f"{namespace}/{name}"


if __name__ == "__main__":
    sys.stdout.write(policy())
