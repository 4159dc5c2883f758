"""Frames on all cores, in order."""

from __future__ import annotations

import collections
import contextlib
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import cv2

T = TypeVar("T")


def in_order(compute: Callable[[int], T], count: int, workers: int | None) -> Iterator[T]:
    """Yield ``compute(0)`` to ``compute(count - 1)``, computed by threads (all cores by default) a few ahead."""
    threads = workers or os.cpu_count() or 1
    with ThreadPoolExecutor(threads) as pool:
        pending: collections.deque[Future[T]] = collections.deque()
        for index in range(count):
            pending.append(pool.submit(compute, index))
            if len(pending) > 2 * threads:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


@contextlib.contextmanager
def single_threaded_opencv() -> Iterator[None]:
    """Keep OpenCV to one thread: where frames are the unit of parallel work, threads within it would only compete with them."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
