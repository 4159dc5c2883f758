"""How the nodes of a graph become processes: by a server that forks them, or each by itself."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import IO, Protocol

from vli_bringup.graph import NodeDescription
from vli_common.node.main import STOP_WITH_PARENT
from vli_common.stop_signals import held_back

_SERVER = "vli_bringup.node_server"
_MESSAGE_BYTES = 65536
_ANSWER_S = 1.0
"""The server tells of a death within this time."""
_POLL_S = 0.05
_LOST = 1
"""Exit code of a node that ended after its server."""


class Process(Protocol):
    """What is used of ``subprocess.Popen``."""

    @property
    def pid(self) -> int:
        """Process id."""

    def poll(self) -> int | None:
        """Return the exit code, None while it runs."""

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit code when it has ended.

        Raises:
            subprocess.TimeoutExpired: it has not.
        """

    def send_signal(self, sig: int) -> None:
        """Send a signal; nothing happens where it has ended."""


def start_singly(node: NodeDescription, arguments: Sequence[str], log: IO[bytes], further: Mapping[str, str]) -> Process:
    """Return a node as a process of its own, standard error to ``log``, with ``further`` variables in its environment.

    A signal that comes before it has its handlers waits until it has.
    """
    environment = {**os.environ, **further, STOP_WITH_PARENT: str(os.getpid())}
    command = [sys.executable, "-m", node.module, *arguments]
    with held_back():
        # A session of its own: Ctrl-C is for the command, which has things to ask of the nodes before it stops them.
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=log, env=environment, start_new_session=True
        )


class NodeServer:
    """The other end of :mod:`vli_bringup.node_server`; nothing here waits for it unless asked to.

    Args:
        modules: of the nodes that it will be asked for.
    """

    def __init__(self, modules: Iterable[str]) -> None:
        self._connection, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  It lives as long as the server.
        with other:
            self._process = subprocess.Popen(
                [sys.executable, "-m", _SERVER, str(other.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._log,
                pass_fds=[other.fileno()],
                start_new_session=True,
            )
        # Not as arguments: who kills the processes that name a node there would kill all of them.
        self._connection.send(json.dumps(list(modules)).encode())
        self._asked: list[ServedProcess] = []
        self._started: dict[int, ServedProcess] = {}
        self.failure: str | None = None
        """Why it has ended, once it has."""

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def start(self, node: NodeDescription, arguments: Sequence[str], log: IO[bytes], further: Mapping[str, str]) -> ServedProcess:
        """Ask for what :func:`start_singly` returns; it runs as soon as the server has loaded it."""
        process = ServedProcess(self)
        self._asked.append(process)
        request = json.dumps({"module": node.module, "arguments": list(arguments), "environment": dict(further)}).encode()
        try:
            socket.send_fds(self._connection, [request], [log.fileno()])
        except OSError:
            self._end()
        return process

    def listen(self, timeout_s: float = 0.0) -> None:
        """Take what the server has to tell; wait for the first of it."""
        while self.failure is None and select.select([self._connection], [], [], timeout_s)[0]:
            timeout_s = 0.0
            message = self._receive()
            if not message:
                self._end()
                return
            told = json.loads(message)
            if "code" in told:
                self._started.pop(told["pid"]).code = told["code"]
            else:
                process = self._asked.pop(0)
                process.started_pid = told["pid"]
                self._started[told["pid"]] = process

    def close(self) -> None:
        """End the server. What it was asked for and has not started, it will not start."""
        self._connection.close()
        if self._asked:
            self._process.kill()
        try:
            self._process.wait(_ANSWER_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._log.close()

    def _receive(self) -> bytes:
        try:
            return self._connection.recv(_MESSAGE_BYTES)
        except OSError:
            return b""

    def _end(self) -> None:
        try:
            code = self._process.wait(_ANSWER_S)
        except subprocess.TimeoutExpired:
            code = None
        self.failure = last_line(self._log) or f"ended with code '{code}' and said nothing"


class ServedProcess:
    """A node that a server was asked for: what is used of ``subprocess.Popen``.

    Args:
        server: that was asked.
    """

    def __init__(self, server: NodeServer) -> None:
        self._server = server
        self.started_pid: int | None = None
        """Process id, None before it was started."""
        self.code: int | None = None
        """Exit code, None before it is known."""

    @property
    def pid(self) -> int:
        """Process id of a node that was started.

        Raises:
            ProcessLookupError: it was not.
        """
        if self.started_pid is None:
            raise ProcessLookupError("the node has not been started yet")
        return self.started_pid

    def poll(self) -> int | None:
        """Return the exit code, None while it runs, or has not been started."""
        self._server.listen()
        if self.code is None and self.started_pid is not None and not _is_running(self.started_pid):
            self._server.listen(_ANSWER_S)
            if self.code is None and self._server.failure is not None:
                self.code = _LOST
        return self.code

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit code when it has ended.

        Raises:
            subprocess.TimeoutExpired: it has not in this time.
        """
        deadline_s = None if timeout is None else time.monotonic() + timeout
        while (code := self.poll()) is None:
            if deadline_s is not None and time.monotonic() > deadline_s:
                raise subprocess.TimeoutExpired("node", timeout or 0.0)
            self._server.listen(_POLL_S) if self._server.failure is None else time.sleep(_POLL_S)
        return code

    def send_signal(self, sig: int) -> None:
        """Send a signal, unless it has ended or was not started."""
        if self.started_pid is not None and self.poll() is None:
            try:
                os.kill(self.started_pid, signal.Signals(sig))
            except ProcessLookupError:
                return


def last_line(log: IO[bytes]) -> str:
    """Return the last line that says something."""
    log.seek(0)
    lines = [line for line in log.read().decode(errors="replace").splitlines() if line.strip()]
    return lines[-1].strip() if lines else ""


def _is_running(pid: int) -> bool:
    """Return False for a process that is gone, or that only waits for its exit code to be read."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] not in "ZX"
