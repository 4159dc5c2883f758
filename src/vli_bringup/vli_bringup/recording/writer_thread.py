"""The thread that writes, so that a slow disk holds up nobody who listens; what it cannot take is counted."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial

from vli_bringup.recording.bag_writer import BagWriter
from vli_bringup.recording.topic import RawMessage, RecordedTopic

QUEUE_BYTES = 256 << 20
"""A second or more of any camera that fits; a disk that stalls for longer costs messages."""
_FLUSH_S = 1.0


class WriterThread:
    """Writes what is put, in that order, and ends a chunk at least once a second.

    Args:
        writer: not used by anybody else meanwhile.
        limit: bytes that may wait.
        flush_s: a chunk takes no longer than this.
    """

    def __init__(self, writer: BagWriter, limit: int = QUEUE_BYTES, flush_s: float = _FLUSH_S) -> None:
        self._writer, self._limit, self._flush_s = writer, limit, flush_s
        self._queue: deque[tuple[RecordedTopic, RawMessage]] = deque()
        self._waiting = 0
        self._changed = threading.Condition()
        self._closing = False
        self.error: OSError | None = None
        """What ended the thread early."""
        self._thread = threading.Thread(target=self._run, name="bag writer", daemon=True)
        self._thread.start()

    def put(self, topic: RecordedTopic, message: RawMessage) -> bool:
        """Hand over a message; return False, and count it as lost, where too much waits already or the disk has failed."""
        with self._changed:
            if self._waiting + len(message.data) > self._limit or self._closing or self.error is not None:
                topic.lost += 1
                return False
            self._queue.append((topic, message))
            self._waiting += len(message.data)
            self._changed.notify()
            return True

    @property
    def is_behind(self) -> bool:
        """True while half of what may wait does: further messages are better left to the middleware, which has room too."""
        with self._changed:
            return self._waiting > self._limit // 2

    def take_the_rest(self) -> None:
        """Refuse nothing any more: what comes from now on has come already, and waits in the middleware."""
        with self._changed:
            self._limit = sys.maxsize

    def close(self) -> OSError | None:
        """Write what waits, then index and metadata; return what made the disk fail, now or before."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()
        self._try(self._writer.close)
        return self.error

    def _run(self) -> None:
        due_s = time.monotonic() + self._flush_s
        while self.error is None:
            batch = self._take(max(0.0, due_s - time.monotonic()))
            if batch is None:
                return
            self._try(partial(self._write, batch))
            if time.monotonic() >= due_s:
                self._try(self._writer.flush)
                due_s = time.monotonic() + self._flush_s

    def _take(self, timeout_s: float) -> list[tuple[RecordedTopic, RawMessage]] | None:
        """Return what waits, nothing after the timeout, None at the end."""
        with self._changed:
            if not self._queue and not self._closing:
                self._changed.wait(timeout_s)
            batch = list(self._queue)
            self._queue.clear()
            return batch if batch or not self._closing else None

    def _write(self, batch: list[tuple[RecordedTopic, RawMessage]]) -> None:
        for topic, message in batch:
            self._writer.write(topic, message)
            with self._changed:
                self._waiting -= len(message.data)

    def _try(self, action: Callable[[], None]) -> None:
        """Do it, unless something has failed before."""
        if self.error is not None:
            return
        try:
            action()
        except OSError as error:
            self.error = error
            self._writer.abandon()
