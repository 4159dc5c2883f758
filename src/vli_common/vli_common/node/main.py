"""The main of every node: starts, spins, and stops with exit code 0 on SIGINT and SIGTERM."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Callable
from contextlib import ExitStack
from typing import NoReturn

import rclpy
from rclpy.signals import SignalHandlerOptions

from vli_common.errors import VliError
from vli_common.node.base import VliNode
from vli_common.node.executor import SPINNER, Spinner
from vli_common.node.leaving import leave_after
from vli_common.node.shared_memory import remove_dead_segments
from vli_common.node.transport import set_transport_profile
from vli_common.stop_signals import STOP, take_over

_SWITCH_S = 2e-4
"""The executor asks for the interpreter for every message. At Python's default of 5 ms, 260 messages a second would take longer
than a second while the worker computes."""
_SIGNAL_S = 0.1
"""A signal is answered this late at most: the executor's wait does not end with it."""
_RELEASE_S = 1.0
"""The middleware may take this long to let go of a node that has saved all it has to save."""
STOP_WITH_PARENT = "VLI_STOP_WITH_PARENT"
"""Environment variable: process id of who started the node; it stops when that is not its parent any more."""
_UNUSABLE = 2
_FAILED = 1


def run_node(factory: Callable[[], VliNode]) -> NoReturn:
    """Run a node until it is told to stop, and end the process.

    Its exit code is 0 stopped by a signal, 1 a stage failed, 2 it could not start (one line says why). First the node ends what
    is its own; then the middleware, which may hang, has a second to take leave of the other nodes. The code is the same either
    way.
    """
    sys.setswitchinterval(_SWITCH_S)
    set_transport_profile()
    remove_dead_segments()
    take_over()
    middleware = ExitStack()
    code = _run(factory, middleware)
    sys.stdout.flush()
    sys.stderr.flush()
    leave_after(_RELEASE_S, code)
    try:
        middleware.close()
    except Exception as error:
        # All is saved, and the process ends in any case: that is worth a line, and no other exit code.
        sys.stderr.write(f"the middleware did not let go of the node: {error}\n")
        sys.stderr.flush()
    # Nothing is left to do, and the interpreter takes a second to take down what it has loaded. It must not do so under a kernel
    # that is being compiled, which cannot be interrupted.
    os._exit(code)


def _run(factory: Callable[[], VliNode], middleware: ExitStack) -> int:
    """Return the exit code once the node has ended what is its own; ``middleware`` gets what then is to be let go of."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    middleware.callback(_shut_down)
    if STOP.is_set():
        return 0
    try:
        node = factory()
    except VliError as error:
        sys.stderr.write(f"{error}\n")
        return _UNUSABLE
    middleware.callback(node.destroy_node)
    code = 0
    try:
        node.start()
        spinner = SPINNER(node)
        middleware.callback(spinner.close)
        _spin(node, spinner)
    except VliError as error:
        code = _UNUSABLE
        sys.stderr.write(f"{error}\n")
    except Exception as error:
        # Of a callback: it ends the node as what a stage raises does, with all that is saved at the end.
        node.fail(error)
    if not node.close():
        # A job that would not end still uses what the middleware would take away.
        middleware.pop_all()
    return code or (_FAILED if node.failure else 0)


def _spin(node: VliNode, spinner: Spinner) -> None:
    told = os.environ.get(STOP_WITH_PARENT, "")
    parent = int(told) if told.isdecimal() else None
    while not (STOP.is_set() or node.failure or node.is_shut_down or parent not in (None, os.getppid())):
        spinner.spin(_SIGNAL_S)


def _shut_down() -> None:
    """Leave the graph; with its last handle the middleware gives back its shared memory."""
    context = rclpy.get_default_context()
    rclpy.try_shutdown()
    gc.collect()
    context.destroy()
