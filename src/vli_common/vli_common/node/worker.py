"""A thread that works off what callbacks enqueue, in order of arrival; under overload the oldest of a stream goes, counted."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from vli_common.types import Counters

Job = Callable[[], None]


class _Entry:
    """A job in the queue; ``job`` is None once it was dropped."""

    __slots__ = ("job", "stream")

    def __init__(self, job: Job, stream: str | None) -> None:
        self.job: Job | None = job
        self.stream = stream


class Worker:
    """One thread, one queue, a limit for each stream; control jobs have no limit and are never dropped.

    Args:
        name: of the thread.
        on_error: called (in the thread) with what a job raised; the thread ends.
    """

    def __init__(self, name: str, on_error: Callable[[Exception], None]) -> None:
        self.dropped = Counters()
        self._on_error = on_error
        self._queue: deque[_Entry] = deque()
        self._streams: dict[str, deque[_Entry]] = {}
        self._changed = threading.Condition()
        self._stopping = self._busy = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def put(self, stream: str, job: Job, limit: int) -> None:
        """Enqueue a job of a stream; where ``limit`` of it wait already, the oldest of them is dropped."""
        with self._changed:
            waiting = self._streams.setdefault(stream, deque())
            if len(waiting) >= limit:
                waiting.popleft().job = None
                self.dropped.add(stream)
            entry = _Entry(job, stream)
            waiting.append(entry)
            self._queue.append(entry)
            self._changed.notify()

    def control(self, job: Job) -> None:
        """Enqueue a job that is never dropped."""
        with self._changed:
            self._queue.append(_Entry(job, None))
            self._changed.notify()

    def clear(self) -> int:
        """Forget all waiting jobs of streams; return how many."""
        with self._changed:
            count = sum(len(waiting) for waiting in self._streams.values())
            for waiting in self._streams.values():
                for entry in waiting:
                    entry.job = None
                waiting.clear()
            return count

    def waiting(self, stream: str) -> int:
        """Return how many jobs of a stream wait."""
        with self._changed:
            return len(self._streams.get(stream, ()))

    @property
    def is_idle(self) -> bool:
        """True where nothing waits and nothing is being done."""
        with self._changed:
            return not self._busy and not any(entry.job for entry in self._queue)

    def stop(self, timeout_s: float) -> bool:
        """Let the thread end after the present job; return False where it did not within the time."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join(timeout_s)
            return not self._thread.is_alive()
        return True

    def _run(self) -> None:
        while (job := self._next()) is not None:
            try:
                job()
            except Exception as error:
                self._on_error(error)
                return

    def _next(self) -> Job | None:
        """Return the next job, None at the end."""
        with self._changed:
            self._busy = False
            while not self._stopping:
                if not self._queue:
                    self._changed.wait()
                    continue
                entry = self._queue.popleft()
                if entry.job is None:
                    continue
                if entry.stream is not None:
                    self._streams[entry.stream].popleft()
                self._busy = True
                return entry.job
            return None
