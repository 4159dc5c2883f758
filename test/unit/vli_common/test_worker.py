"""The worker: order, overload, control jobs, failure and the end."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import pytest

from vli_common.node.worker import Worker


class Harness:
    """A worker that starts when told to, and what its jobs did."""

    def __init__(self) -> None:
        self.done: list[object] = []
        self.errors: list[Exception] = []
        self.worker = Worker("test", self.errors.append)

    def job(self, name: object) -> Callable[[], None]:
        return lambda: self.done.append(name)

    def run_all(self) -> None:
        """Run what is enqueued and wait for it."""
        finished = threading.Event()
        self.worker.control(finished.set)
        self.worker.start()
        assert finished.wait(5.0)


@pytest.fixture
def harness() -> Iterator[Harness]:
    item = Harness()
    yield item
    item.worker.stop(1.0)


def test_jobs_of_all_streams_run_in_order_of_arrival(harness: Harness) -> None:
    for name in range(6):
        harness.worker.put(f"stream {name % 2}", harness.job(name), limit=10)
    harness.run_all()
    assert harness.done == [0, 1, 2, 3, 4, 5]


def test_under_overload_the_oldest_of_that_stream_goes_and_is_counted(harness: Harness) -> None:
    for name in range(5):
        harness.worker.put("images", harness.job(f"image {name}"), limit=2)
        harness.worker.put("imu", harness.job(f"imu {name}"), limit=10)
    assert harness.worker.waiting("images") == 2
    harness.run_all()
    assert [name for name in harness.done if str(name).startswith("image")] == ["image 3", "image 4"]
    assert len(harness.done) == 7
    assert harness.worker.dropped.values == {"images": 3}


def test_clearing_forgets_data_but_no_control_jobs(harness: Harness) -> None:
    harness.worker.put("images", harness.job("old"), limit=5)
    harness.worker.control(harness.job("control"))
    assert harness.worker.clear() == 1
    harness.worker.put("images", harness.job("new"), limit=5)
    harness.run_all()
    assert harness.done == ["control", "new"]
    assert harness.worker.dropped.values == {}


def test_a_job_that_raises_is_reported_and_nothing_runs_after_it(harness: Harness) -> None:
    failed = threading.Event()
    harness.worker = Worker("test", lambda error: (harness.errors.append(error), failed.set()))

    def fail() -> None:
        raise ValueError("broken")

    harness.worker.control(fail)
    harness.worker.control(harness.job("after"))
    harness.worker.start()
    assert failed.wait(5.0)
    assert str(harness.errors[0]) == "broken"
    assert harness.done == []
    assert harness.worker.stop(1.0)


def test_it_is_idle_only_when_nothing_waits_and_nothing_is_done(harness: Harness) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def hold() -> None:
        begun.set()
        go_on.wait(5.0)

    harness.worker.put("images", hold, limit=1)
    assert not harness.worker.is_idle
    harness.worker.start()
    assert begun.wait(5.0)
    assert not harness.worker.is_idle
    assert not harness.worker.stop(0.05), "the job is still running"
    go_on.set()
    assert harness.worker.stop(5.0)
    assert harness.worker.is_idle
