"""The main of every node: starts, spins, and stops with exit code 0 on SIGINT and SIGTERM."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

from vli_common.errors import VliError
from vli_common.node.base import VliNode
from vli_common.node.transport import set_transport_profile

_SWITCH_S = 2e-4
"""The executor asks for the interpreter for every message. At Python's default of 5 ms, 260 messages a second would take longer
than a second while the worker computes."""
_REST_S = 2e-3
"""What comes in this time is taken in one round of the executor; see :func:`vli_common.node.transport.pending`."""
_UNUSABLE = 2
_FAILED = 1


def run_node(factory: Callable[[], VliNode]) -> int:
    """Run a node until it is told to stop.

    Returns:
        0 stopped by a signal, 1 a stage failed, 2 it could not start (one line says why).
    """
    sys.setswitchinterval(_SWITCH_S)
    set_transport_profile()
    rclpy.init()
    node: VliNode | None = None
    code = 0
    try:
        node = factory()
        node.start()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while True:
            executor.spin_once()
            time.sleep(_REST_S)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except VliError as error:
        code = _UNUSABLE
        sys.stderr.write(f"{error}\n")
    except Exception:
        # A signal while the node is being made takes its context away: whatever that raises is no failure.
        if rclpy.ok():
            raise
    stopped = True
    if node is not None:
        stopped = node.close()
        code = code or (_FAILED if node.failure else 0)
    rclpy.try_shutdown()
    if not stopped:
        # A kernel that is being compiled cannot be interrupted, and an interpreter must not end under it.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code
