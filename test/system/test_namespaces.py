"""Two scanners side by side: each in a namespace of its own, as the launch files set it up."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from graph_tools import command, wait
from tiny_bag import write_calibration

from vli_bringup.graph import remappings
from vli_bringup.listener import GraphListener
from vli_common.calibration import load_calibration

_UNKNOWN = "_NODE_NAMESPACE_UNKNOWN_"
"""What ROS says of an end whose node it has not heard of yet."""

pytestmark = pytest.mark.graph


def test_scanners_in_namespaces_of_their_own_share_nothing_but_diagnostics(tmp_path: Path) -> None:
    calibration = write_calibration(tmp_path / "calibration.yaml")
    with GraphListener(load_calibration(calibration)) as listener:
        node = listener.node
        processes = []
        for name in ("left", "right"):
            renamed = [item for pair in remappings(name) for item in ("-r", ":=".join(pair))]
            for executable in ("driver_node", "frontend_node"):
                processes.append(subprocess.Popen([*command(executable), "-r", f"__ns:=/{name}", *renamed]))
        try:
            wanted = {
                f"/{name}/{topic}" for name in ("left", "right") for topic in ("camera/image_raw", "imu", "tracks", "status")
            }

            def topics() -> dict[str, set[str]]:
                """Return the namespaces of those who publish or hear each topic, this process left out."""
                found: dict[str, set[str]] = {}
                for topic, _ in node.get_topic_names_and_types():
                    ends = node.get_publishers_info_by_topic(topic) + node.get_subscriptions_info_by_topic(topic)
                    found[topic] = {end.node_namespace for end in ends} - {node.get_namespace()}
                return found

            def is_known() -> bool:
                """Return whether all are there, and the name of everyone who is: an end is heard of before its node."""
                found = topics()
                named = all(topic in found and _UNKNOWN not in found[topic] for topic in wanted)
                return named and {"/left", "/right"} <= found.get("/diagnostics", set())

            wait(listener, is_known)
            shared = {topic for topic, spaces in topics().items() if {"/left", "/right"} <= spaces}
            assert shared - {"/rosout", "/parameter_events"} == {"/diagnostics"}
            assert topics()["/left/imu"] == {"/left"}
        finally:
            for process in processes:
                process.terminate()
            for process in processes:
                process.wait(20)
