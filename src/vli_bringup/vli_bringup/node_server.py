"""A process that has loaded all nodes and starts them as copies of itself.

``python -m vli_bringup.node_server SOCKET``; the first message names the modules. To import the libraries of a node takes 0.5 to
0.7 s of a processor and to load its kernels 0.3 to 0.5 s, twice that where the graph plays meanwhile. Here both are done once for
all nodes, and a node that is started, or started again, is a fork away.

What is forked must not have threads, and must not have spoken ROS. So the kernels run in one thread, and the middleware is loaded
but not initialised. The two threads that LTTng brings with rclpy sleep until somebody traces; a node that was forked has none.

Not ``multiprocessing``'s fork server: it runs the main module of the command again in every node, brings a resource tracker, and
cannot be told to end.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import select
import signal
import socket
import sys
import traceback
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

import rclpy.type_support
from rclpy.utilities import get_rmw_implementation_identifier

from vli_common.errors import VliError
from vli_common.node.main import STOP_WITH_PARENT
from vli_common.node.transport import message_type
from vli_common.stop_signals import held_back, take_over
from vli_common.topics import TOPICS

MESSAGE_BYTES = 65536
_NAME_BYTES = 15
"""Of a process, as the kernel keeps it."""


def threads() -> int:
    """Return how many threads this process has, those of libraries too."""
    return len(os.listdir("/proc/self/task"))


def load(modules: Iterable[str]) -> None:
    """Import the modules of nodes, message types and middleware, and run all kernels once.

    Raises:
        VliError: that has started a thread, which a fork would lose.
    """
    before = threads()
    for module in modules:
        importlib.import_module(module)
    get_rmw_implementation_identifier()
    for topic in TOPICS:
        # The pip wheels of ROS have no tf2_msgs.
        with contextlib.suppress(ImportError):
            rclpy.type_support.check_for_type_support(message_type(topic))
    for package in dict.fromkeys(["vli_common", *(module.partition(".")[0] for module in modules)]):
        importlib.import_module(f"{package}.warm_up").warm_up()
    if threads() != before:
        raise VliError(f"the libraries have '{threads() - before}' threads that a fork would lose")


def serve(connection: socket.socket) -> None:
    """Start what is asked for and tell what has ended, until the other end is closed.

    A request is ``{"module": ..., "arguments": [...], "environment": {...}}`` with a file descriptor for standard error. The
    answers: ``{"pid": ...}`` for each request, in order, and ``{"pid": ..., "code": ...}`` for each process that has ended,
    negative for a signal.
    """
    awake, wake = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    while True:
        ready, _, _ = select.select([connection.fileno(), awake], [], [])
        if awake in ready:
            os.read(awake, MESSAGE_BYTES)
            for pid, code in _ended():
                _send(connection, {"pid": pid, "code": code})
        if connection.fileno() in ready:
            message, files, _, _ = socket.recv_fds(connection, MESSAGE_BYTES, 1)
            if not message:
                return
            request = json.loads(message)
            _send(connection, {"pid": _fork(request, files[0], (connection.fileno(), awake, wake))})
            os.close(files[0])


def _send(connection: socket.socket, message: dict[str, Any]) -> None:
    """Send, unless nobody is there any more: the next reading ends the server."""
    with contextlib.suppress(OSError):
        connection.send(json.dumps(message).encode())


def _ended() -> list[tuple[int, int]]:
    """Return process id and exit code of every child that has ended."""
    found = []
    with contextlib.suppress(ChildProcessError):
        while (ended := os.waitpid(-1, os.WNOHANG))[0]:
            found.append((ended[0], os.waitstatus_to_exitcode(ended[1])))
    return found


def _fork(request: dict[str, Any], log: int, own: Iterable[int]) -> int:
    """Start a node that has none of the server's ``own`` file descriptors; return its process id."""
    parent = os.getpid()
    with held_back(), warnings.catch_warnings():
        # Python 3.12 warns of LTTng's threads.
        warnings.simplefilter("ignore", DeprecationWarning)
        pid = os.fork()
        if pid == 0:
            signal.set_wakeup_fd(-1)
            for descriptor in own:
                os.close(descriptor)
            os.environ.update(request["environment"], **{STOP_WITH_PARENT: str(parent)})
            _become(request["module"], request["arguments"], log)
    return pid


def _become(module: str, arguments: list[str], log: int) -> NoReturn:
    """Be a node, as if started by ``python -m module arguments``."""
    try:
        # A session of its own: Ctrl-C is for the command, which has things to ask of the nodes before it stops them.
        os.setsid()
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        nothing = os.open(os.devnull, os.O_RDWR)
        for source, target in ((nothing, 0), (nothing, 1), (log, 2)):
            os.dup2(source, target)
        os.close(log)
        os.close(nothing)
        name = module.rpartition(".")[2]
        Path("/proc/self/comm").write_text(name[:_NAME_BYTES])
        sys.argv[:] = [name, *arguments]
        take_over()
        importlib.import_module(module).main()
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    os._exit(1)


def main() -> int:
    """Load, then serve; return 2 where that cannot be done, with a line that says why."""
    # Ctrl-C is for the command; without it this server ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    connection = socket.socket(fileno=int(sys.argv[1]))
    try:
        load(json.loads(connection.recv(MESSAGE_BYTES) or "[]"))
    except VliError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    # Nodes write to what is collected, which would copy its pages.
    gc.collect()
    gc.freeze()
    serve(connection)
    return 0


if __name__ == "__main__":
    sys.stdout.flush()
    os._exit(main())
