"""What SIGINT and SIGTERM do to a node: while it is being loaded they end it, from then on they set an event.

Loading a node takes a second or two, on a busy machine ten. A signal in that time would end it with the traceback of whatever was
being imported, and in the middle of a C extension with an ImportError. There is nothing to save yet and nobody to take leave of,
so that it ends at once. Later, a handler that raises could do so in the middle of a constructor or a callback, and what it leaves
half made complains on standard error when it is collected.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

STOP = threading.Event()
"""Set by the first signal."""
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def take_over() -> None:
    """Let the signals set :data:`STOP`, those too that :func:`held_back` has kept waiting; call in the main thread."""
    _handle(STOP.set)


@contextmanager
def held_back() -> Iterator[None]:
    """Keep the signals waiting: here until the block ends, in a process that is started in it until that calls :func:`take_over`.

    Before Python is there a signal ends a process, or leaves it with a traceback, and only who starts it can prevent that.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def take_over_in_nodes(package: str) -> None:
    """Let the signals end this process with exit code 0 where it was started to run a node of ``package``.

    Not where one is only imported.
    """
    started = sys.orig_argv[1:3]
    is_module = started[:1] == ["-m"] and started[-1].startswith(f"{package}.")
    is_script = Path(sys.argv[0]).name.endswith("_node")
    if (is_module or is_script) and threading.current_thread() is threading.main_thread():
        _handle(lambda: os._exit(0))


def _handle(action: Callable[[], None]) -> None:
    for number in _SIGNALS:
        signal.signal(number, lambda *_: action())
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
