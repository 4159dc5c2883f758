"""One of two hosts: `python one_host.py driver|rest DEMO PARAMETERS`; says twice a second, as a line of JSON, what it knows.

A host has shared memory of its own: run it where ``/dev/shm`` may be mounted over.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

from graph_tools import demo_graph, text

from vli_bringup.graph import SCANNER
from vli_bringup.listener import GraphListener
from vli_bringup.processes import NodeProcesses
from vli_common.calibration import load_calibration

_SAY_S = 0.5


def main() -> None:
    """Run until killed, or until whoever reads is gone."""
    role, demo, parameter_file = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    subprocess.run(["mount", "-t", "tmpfs", "tmpfs", "/dev/shm"], check=True)
    nodes = demo_graph(demo, {SCANNER: {"loop": True}})
    own = [node for node in nodes if (node.executable == SCANNER) == (role == "driver")]
    calibration = load_calibration(demo / "calibration.yaml")
    with NodeProcesses(own, parameter_file) as processes, GraphListener(calibration) as listener:
        while True:
            until_s = time.monotonic() + _SAY_S
            while time.monotonic() < until_s:
                processes.check()
                listener.spin()
            known = {
                "nodes": sorted(listener.statuses),
                "session": listener.value("demux_node", "session"),
                "images": sum(
                    listener.value("demux_node", f"received./camera/image_raw{suffix}") for suffix in ("", "/compressed")
                ),
                "tracking": text(listener, "backend_node", "tracking"),
                "poses": listener.sessions.poses,
                "restarts": processes.restarts,
            }
            print(json.dumps(known), flush=True)


if __name__ == "__main__":
    main()
