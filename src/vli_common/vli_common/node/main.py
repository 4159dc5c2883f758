"""The main of every node: starts, spins, and stops with exit code 0 on SIGINT and SIGTERM."""

from __future__ import annotations

import faulthandler
import gc
import os
import sys
import threading
from collections.abc import Callable
from typing import NoReturn

import rclpy
from rclpy.signals import SignalHandlerOptions

from vli_common.errors import VliError
from vli_common.node.base import VliNode
from vli_common.node.executor import SPINNER
from vli_common.node.transport import set_transport_profile
from vli_common.stop_signals import STOP, take_over

_SWITCH_S = 2e-4
"""The executor asks for the interpreter for every message. At Python's default of 5 ms, 260 messages a second would take longer
than a second while the worker computes."""
_SIGNAL_S = 0.1
"""A signal is answered this late at most: the executor's wait does not end with it."""
_TEARDOWN_S = 3.0
"""The middleware may take this long to let go of a node that has stopped, its worker's last job included."""
STOP_WITH_PARENT = "VLI_STOP_WITH_PARENT"
"""Environment variable: process id of who started the node; it stops when that is not its parent any more."""
_UNUSABLE = 2
_FAILED = 1


def run_node(factory: Callable[[], VliNode]) -> NoReturn:
    """Run a node until it is told to stop, and end the process.

    Its exit code is 0 stopped by a signal, 1 a stage failed, 2 it could not start (one line says why).
    """
    sys.setswitchinterval(_SWITCH_S)
    set_transport_profile()
    take_over()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    code, stopped = _run(factory)
    context = rclpy.get_default_context()
    rclpy.try_shutdown()
    if stopped:
        # With the last handle the middleware gives back its shared memory.
        gc.collect()
        context.destroy()
    # Nothing is left to do, and the interpreter takes a second to take down what it has loaded. It must not do so under a kernel
    # that is being compiled, which cannot be interrupted.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _run(factory: Callable[[], VliNode]) -> tuple[int, bool]:
    """Return the exit code, and whether the node's own threads have ended."""
    if STOP.is_set():
        return 0, True
    try:
        node = factory()
    except VliError as error:
        sys.stderr.write(f"{error}\n")
        return _UNUSABLE, True
    code = 0
    try:
        node.start()
        _spin(node)
    except VliError as error:
        code = _UNUSABLE
        sys.stderr.write(f"{error}\n")
    code = code or (_FAILED if node.failure else 0)
    _limit_teardown(code)
    return code, node.close()


def _limit_teardown(code: int) -> None:
    """Let the process end in time whatever the middleware does; where it hangs in native code, say where."""
    limit = threading.Timer(_TEARDOWN_S, os._exit, [code])
    limit.daemon = True
    limit.start()
    faulthandler.dump_traceback_later(2 * _TEARDOWN_S, exit=True)


def _spin(node: VliNode) -> None:
    spinner = SPINNER(node)
    told = os.environ.get(STOP_WITH_PARENT, "")
    parent = int(told) if told.isdecimal() else None
    while not (STOP.is_set() or node.failure or node.is_shut_down or parent not in (None, os.getppid())):
        spinner.spin(_SIGNAL_S)
    spinner.close()
