"""Services that take long: done in a thread, one after another, while the executor goes on taking messages."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

T = TypeVar("T")


class Aside:
    """Runs actions in threads of their own, never two at a time.

    Args:
        name: of the threads.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._turn = threading.Lock()
        self._threads: list[threading.Thread] = []

    def run(self, action: Callable[[], T]) -> Future[T]:
        """Begin an action; return what will hold its result, or what it raised."""
        future: Future[T] = Future()

        def work() -> None:
            with self._turn:
                try:
                    future.set_result(action())
                except Exception as error:
                    future.set_exception(error)

        self._threads = [thread for thread in self._threads if thread.is_alive()]
        self._threads.append(threading.Thread(target=work, name=f"{self._name} service", daemon=True))
        self._threads[-1].start()
        return future

    def finish(self, timeout_s: float) -> None:
        """Give what is under way this long to end."""
        for thread in self._threads:
            thread.join(timeout_s / len(self._threads))
