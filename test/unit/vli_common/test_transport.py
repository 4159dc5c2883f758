"""What the middleware leaves behind."""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from vli_common.node.transport import (
    NETWORK_PROFILE,
    SHARED_MEMORY_PROFILE,
    UDP_PROFILE,
    local_profile,
    set_transport_profile,
    use_fresh_ports,
)

_PROFILE, _RANGE = "FASTRTPS_DEFAULT_PROFILES_FILE", "ROS_AUTOMATIC_DISCOVERY_RANGE"


@pytest.fixture(autouse=True)
def asked_anew() -> Iterator[None]:
    """What the machine grants is remembered by a process, which is not to remember what a test made of it."""
    local_profile.cache_clear()
    yield
    local_profile.cache_clear()


@pytest.mark.parametrize(("allowed", "profile"), [(212_992, SHARED_MEMORY_PROFILE), (4_194_304, UDP_PROFILE)])
def test_udp_is_for_machines_whose_sockets_may_hold_images(monkeypatch: pytest.MonkeyPatch, allowed: int, profile: Path) -> None:
    class Socket(socket.socket):
        granted = 0

        def setsockopt(self, level: int, name: int, value: int) -> None:  # type: ignore[override]
            assert (level, name) == (socket.SOL_SOCKET, socket.SO_RCVBUF)
            # As Linux does: no more than is allowed, and twice that for its own needs.
            self.granted = 2 * min(value, allowed)

        def getsockopt(self, level: int, name: int) -> int:  # type: ignore[override]
            return self.granted

    monkeypatch.setattr(socket, "socket", Socket)
    assert local_profile() == profile


def test_the_profiles_ask_for_sockets_that_hold_four_images() -> None:
    image_bytes = 640 * 480 * 3
    for profile in (UDP_PROFILE, SHARED_MEMORY_PROFILE, NETWORK_PROFILE):
        (size,) = re.findall("<receiveBufferSize>([0-9]+)</receiveBufferSize>", profile.read_text())
        assert int(size) > 4 * image_bytes


@pytest.mark.parametrize("base", [UDP_PROFILE, SHARED_MEMORY_PROFILE])
def test_a_node_started_again_has_ports_of_its_own_unless_the_profile_is_foreign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, base: Path
) -> None:
    monkeypatch.delenv("FASTDDS_DEFAULT_PROFILES_FILE", raising=False)
    monkeypatch.setenv(_PROFILE, str(base))
    monkeypatch.delenv(_RANGE, raising=False)
    offsets: list[int] = []
    for number in range(1, 6):
        ((variable, profile),) = use_fresh_ports(tmp_path, number).items()
        assert variable == _PROFILE
        text = Path(profile).read_text()
        offsets += map(int, re.findall("<offsetd3>([0-9]+)</offsetd3>", text))
        assert re.sub("<port>.*</port>", "", text) == base.read_text()
    assert len(set(offsets)) == 5
    # Odd, since even ones are for discovery, and none is the first's.
    assert all(offset % 2 and 11 < offset < 250 for offset in offsets)
    monkeypatch.setenv(_PROFILE, "/my/own.xml")
    assert use_fresh_ports(tmp_path, 1) == {}


@pytest.mark.parametrize(("asked", "given"), [("LOCALHOST", "SYSTEM_DEFAULT"), ("OFF", "OFF"), ("SUBNET", "SUBNET")])
def test_who_asks_for_this_machine_alone_gets_the_profile_which_has_nothing_else_and_no_transports_of_rmw_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: str, given: str
) -> None:
    monkeypatch.delenv("FASTDDS_DEFAULT_PROFILES_FILE", raising=False)
    monkeypatch.setenv(_PROFILE, "")
    monkeypatch.setenv(_RANGE, asked)
    assert use_fresh_ports(tmp_path, 1).get(_RANGE, asked) == given
    set_transport_profile()
    assert (os.environ[_PROFILE], os.environ[_RANGE]) == (str(local_profile()), given)
    # Nodes that are started again are children of a process which this one started before.
    assert use_fresh_ports(tmp_path, 1).get(_RANGE, asked) == given


def test_a_foreign_profile_and_the_range_beside_it_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(_PROFILE, "/my/own.xml")
    monkeypatch.setenv(_RANGE, "LOCALHOST")
    set_transport_profile()
    assert (os.environ[_PROFILE], os.environ[_RANGE]) == ("/my/own.xml", "LOCALHOST")
