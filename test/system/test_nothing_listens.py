"""By default no node is heard from, or hears, another machine: what its process has opened is looked up in /proc."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.graph

_ON_LOOPBACK = 4
"""Sockets of a participant: discovery, data, and one to send from, at the least."""
_START_S = 60.0
_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_GROUP = ipaddress.ip_address("239.255.0.1")
"""Of DDS, for discovery."""
# Two more interfaces, with addresses of their own: a node that listened on everything would be found there.
_ANOTHER_INTERFACE = """
ip link set lo up && ip link set lo multicast on || exit 1
ip link add plug0 type veth peer name plug1 && ip addr add 10.83.13.1/24 dev plug0 || exit 1
ip link set plug0 up && ip link set plug1 up || exit 1
exec "$@"
"""


def address(text: str) -> ipaddress.IPv4Address:
    """Return the address of a line of /proc/net, which has it in hexadecimal, the last byte first."""
    return ipaddress.IPv4Address(int.from_bytes(bytes.fromhex(text.split(":")[0]), "little"))


def own_lines(pid: int, table: str) -> list[list[str]]:
    """Return the lines of /proc/net/``table`` that are sockets of a process."""
    inodes = set()
    for path in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            inodes.update(re.findall(r"socket:\[(\d+)\]", os.readlink(path)))
    lines = (line.split() for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:])
    return [line for line in lines if line[9] in inodes]


def memberships(pid: int) -> dict[str, set[ipaddress.IPv4Address]]:
    """Return interface → multicast groups that anyone in the network namespace of a process has joined there."""
    groups: dict[str, set[ipaddress.IPv4Address]] = {}
    name = ""
    for line in Path(f"/proc/{pid}/net/igmp").read_text().splitlines()[1:]:
        if not line.startswith("\t"):
            name = line.split()[1]
        else:
            groups.setdefault(name, set()).add(address(line.split()[0]))
    return groups


def can_have_namespaces() -> bool:
    if os.geteuid() != 0:
        return False
    probe = ["unshare", "--net", "sh", "-c", _ANOTHER_INTERFACE, "sh", "true"]
    return subprocess.run(probe, check=False, capture_output=True).returncode == 0


@pytest.fixture(scope="module", params=[{}, {_RANGE: "LOCALHOST"}], ids=["nothing set", "LOCALHOST"])
def node(request: pytest.FixtureRequest) -> Iterator[tuple[int, bool]]:
    """Return the process id of a node with this environment, and whether it is in a network namespace of its own."""
    unset = (_RANGE, "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
    environment = {name: value for name, value in os.environ.items() if name not in unset} | request.param
    isolated = can_have_namespaces()
    inside = ["unshare", "--net", "sh", "-c", _ANOTHER_INTERFACE, "sh"] if isolated else []
    process = subprocess.Popen([*inside, sys.executable, "-m", "vli_driver.nodes.driver_node"], env=environment)
    try:
        deadline_s = time.monotonic() + _START_S
        while len(own_lines(process.pid, "udp")) < _ON_LOOPBACK and time.monotonic() < deadline_s:
            time.sleep(0.2)
        time.sleep(1.0)
        yield process.pid, isolated
    finally:
        process.terminate()
        process.wait(10)


def test_every_socket_is_of_the_loopback_interface(node):
    pid, _ = node
    bound = [address(line[1]) for line in own_lines(pid, "udp")]
    assert len(bound) >= _ON_LOOPBACK
    assert [item for item in bound if not (item.is_loopback or item == _GROUP)] == []
    assert [own_lines(pid, table) for table in ("tcp", "tcp6", "udp6")] == [[], [], []]


def test_the_group_for_discovery_is_joined_on_the_loopback_interface_only(node):
    pid, isolated = node
    if not isolated:
        pytest.skip("needs root, 'unshare' and 'ip': without a network of its own, other programs join groups as well")
    joined = memberships(pid)
    assert "plug0" in joined
    assert {name for name, groups in joined.items() if _GROUP in groups} == {"lo"}
