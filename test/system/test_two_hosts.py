"""The driver on one host, the rest on another: two network namespaces, joined by a cable that is pulled for three seconds."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from graph_tools import START_S

from vli_common.node.transport import NETWORK_PROFILE

pytestmark = [pytest.mark.graph, pytest.mark.slow]

_HERE = Path(__file__).parent
_CUT_S = 3.0


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


class Hosts:
    """Two network namespaces with one cable between them."""

    def __init__(self) -> None:
        number = random.randrange(10**6)
        self.names = [f"vli{side}{number}" for side in "ab"]
        self._plugs = [f"v{side}{number}" for side in "ab"]
        for name in self.names:
            ip("netns", "add", name)
        ip("link", "add", self._plugs[0], "type", "veth", "peer", "name", self._plugs[1])
        for index, (name, plug) in enumerate(zip(self.names, self._plugs, strict=True)):
            ip("link", "set", plug, "netns", name)
            ip("-n", name, "addr", "add", f"10.83.12.{index + 1}/24", "dev", plug)
            for device in (plug, "lo"):
                ip("-n", name, "link", "set", device, "up")

    def set_cable(self, state: str) -> None:
        """Pull the cable (``down``), or put it in again (``up``)."""
        ip("-n", self.names[0], "link", "set", self._plugs[0], state)

    def remove(self) -> None:
        for name in self.names:
            subprocess.run(["ip", "netns", "del", name], check=False, capture_output=True)


@pytest.fixture
def hosts() -> Iterator[Hosts]:
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and the command 'ip' (iproute2)")
    try:
        made = Hosts()
    except subprocess.CalledProcessError as error:
        pytest.skip(f"network namespaces cannot be made here: {error.stderr.strip()}")
    yield made
    made.remove()


class Host:
    """A process of :mod:`one_host` in a namespace, and the newest that it has said."""

    def __init__(self, name: str, role: str, demo: Path, parameter_file: Path) -> None:
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, [str(_HERE), os.environ.get("PYTHONPATH")])),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
            "FASTRTPS_DEFAULT_PROFILES_FILE": str(NETWORK_PROFILE),
            "ROS_DOMAIN_ID": "7",
        }
        script = [sys.executable, str(_HERE / "one_host.py"), role, str(demo), str(parameter_file)]
        command = ["ip", "netns", "exec", name, *script]
        self._process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        self._said = self._process.stdout

    def wait(self, condition: Callable[[dict[str, Any]], bool], timeout_s: float = START_S) -> dict[str, Any]:
        """Return the first thing said from now on that meets a condition."""
        deadline_s = time.monotonic() + timeout_s
        said: dict[str, Any] = {}
        while not said or not condition(said):
            assert time.monotonic() < deadline_s, said
            line = self._said.readline()
            assert line, f"the host has died; it said last: {said}"
            said = json.loads(line)
        return said

    def listen(self, seconds: float) -> dict[str, Any]:
        """Return what is said last within some seconds."""
        until_s = time.monotonic() + seconds
        return self.wait(lambda said: time.monotonic() > until_s)

    def stop(self) -> None:
        self._process.terminate()
        self._process.wait(20)


def test_a_cable_pulled_for_three_seconds_interrupts_the_graph_and_no_more(
    hosts: Hosts, repository: Path, parameter_file: Path
) -> None:
    demo = repository / "bags" / "demo"
    driver, rest = (Host(name, role, demo, parameter_file) for name, role in zip(hosts.names, ("driver", "rest"), strict=True))
    try:
        rest.wait(lambda said: said["tracking"] == "TRACKING" and said["poses"] > 0)
        hosts.set_cable("down")
        rest.listen(1.5)
        cut = rest.listen(0.1)
        later = rest.listen(_CUT_S - 1.6)
        assert later["images"] - cut["images"] <= 2, "the cable is out, and images come all the same"
        hosts.set_cable("up")
        again = rest.wait(lambda said: said["images"] > later["images"] + 30 or said["session"] > later["session"], 60.0)
        # The bag of seven seconds soon begins anew, and with it a session whose images are counted from zero.
        back = rest.wait(lambda said: said["tracking"] == "TRACKING" and said["poses"] > again["poses"], 60.0)
        assert back["restarts"] == {}
        assert set(back["nodes"]) == {"driver_node", "demux_node", "frontend_node", "backend_node", "mapping_node"}
    finally:
        driver.stop()
        rest.stop()
