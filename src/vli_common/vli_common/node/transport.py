"""Fast DDS profile and quality of service."""

from __future__ import annotations

import functools
import importlib
import os
import socket
from pathlib import Path
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from vli_common.topics import Topic

_PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
_RANGE_VARIABLE, _LOCALHOST, _AS_THE_PROFILE_SAYS = "ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST", "SYSTEM_DEFAULT"
_READER_FACTOR = 8
_FIRST_PORT, _PORT_STEP, _PORT_STEPS = 11, 32, 7
"""Offset of the first participant's port for data within the 250 of a domain (RTPS 2.2, 9.6.1.1), and how far others move it."""
_RECEIVE_BYTES = 4_194_304
"""A socket must hold, as the profiles say: four images."""
UDP_PROFILE = Path(__file__).with_name("fastdds_local.xml")
SHARED_MEMORY_PROFILE = Path(__file__).with_name("fastdds_shared_memory.xml")
NETWORK_PROFILE = Path(__file__).with_name("fastdds_network.xml")


def set_transport_profile() -> None:
    """Let Fast DDS use :func:`local_profile` unless the environment names another; call before ``rclpy.init``."""
    named = _named_profile()
    if _is_ours(named):
        os.environ.update(_environment(Path(named) if named else local_profile()))


@functools.cache
def local_profile() -> Path:
    """Return the profile for nodes on one machine.

    :data:`UDP_PROFILE` where sockets may be as large as it asks for, else :data:`SHARED_MEMORY_PROFILE`: sockets of 0.4 MB, the
    most that Linux allows unless ``net.core.rmem_max`` is raised, lose parts of images on a busy machine.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BYTES)
        granted = probe.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    return UDP_PROFILE if granted >= _RECEIVE_BYTES else SHARED_MEMORY_PROFILE


def use_fresh_ports(directory: Path, number: int) -> dict[str, str]:
    """Return the environment in which a node that is started again listens where its predecessor did not.

    The others go on writing to the port of a process that was killed, for 20 s by UDP. In shared memory they do so until Fast DDS
    notices after two seconds; a new owner of the same port has memory of its own, and hears nothing until then. Empty where the
    profile is not ours.

    Args:
        directory: for the profile.
        number: of the start; another one each time.
    """
    named = _named_profile()
    if not _is_ours(named):
        return {}
    base = Path(named) if named else local_profile()
    ports = f"<port><offsetd3>{_FIRST_PORT + _PORT_STEP * (number % _PORT_STEPS)}</offsetd3></port>"
    profile = directory / f"ports{number}.xml"
    profile.write_text(base.read_text().replace("</rtps>", f"{ports}</rtps>"))
    return _environment(profile)


def _named_profile() -> str:
    """Return the profile that the environment names, empty where it names none."""
    return next(filter(None, (os.environ.get(name, "") for name in _PROFILE_VARIABLES)), "")


def _is_ours(named: str) -> bool:
    return named in ("", str(UDP_PROFILE), str(SHARED_MEMORY_PROFILE))


def _environment(profile: Path) -> dict[str, str]:
    """Return the variables that have a process use ``profile``, which has the loopback interface only."""
    variables = {_PROFILE_VARIABLES[0]: str(profile)}
    if os.environ.get(_RANGE_VARIABLE) in (_LOCALHOST, _AS_THE_PROFILE_SAYS):
        # For LOCALHOST, rmw adds transports of its own, with sockets on every interface and shared memory, and has each
        # announcement go out twice to 32 ports instead of once to the group. Where this process has had that replaced for itself,
        # a child may still come from one that has not.
        variables[_RANGE_VARIABLE] = _AS_THE_PROFILE_SAYS
    return variables


def quality(topic: Topic, reading: bool = False) -> QoSProfile:
    """Return the quality of service of a topic: always RELIABLE, as a best-effort publisher never reaches a reliable reader.

    Args:
        topic: of the table; a publisher keeps its depth, or ``kept``.
        reading: True for a subscriber: it keeps more, since a callback may wait for the interpreter while a kernel runs, and a
            full reader loses even RELIABLE messages.
    """
    factor = _READER_FACTOR if reading and not topic.transient_local else 1
    return QoSProfile(
        depth=max(factor * topic.depth, topic.kept),
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if topic.transient_local else DurabilityPolicy.VOLATILE,
    )


def message_type(topic: Topic) -> Any:
    """Return the message class of a topic."""
    package, _, name = topic.type.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)
