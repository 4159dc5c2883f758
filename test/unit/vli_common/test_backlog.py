"""What an overloaded node leaves out, and when."""

from __future__ import annotations

import pytest

from vli_common.node.backlog import INTERVAL_S, TARGET_S, Backlog
from vli_common.node.inputs import Input
from vli_common.topics import IMAGE_RAW

PERIOD_S = 1.0 / 60.0


class Clock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


class Queue:
    """Messages at 60 Hz that a node works off one after another, in simulated time."""

    def __init__(self, sheds: int = 1) -> None:
        self.clock = Clock()
        self.backlog = Backlog(self.clock)
        self.input = Input(IMAGE_RAW, "image", True, True, sheds)
        self.latencies_s: list[float] = []
        self.kept: list[int] = []
        self.count = 0

    def run(self, seconds: float, work_s: float) -> None:
        """Handle what arrives in some seconds, each message taking ``work_s``."""
        for index in range(self.count, self.count + round(seconds / PERIOD_S)):
            arrived_s = index * PERIOD_S
            self.clock.now_s = max(self.clock.now_s, arrived_s)
            if self.input.is_shed(self.backlog.is_behind(arrived_s)):
                continue
            self.clock.now_s += work_s
            self.kept.append(index)
            self.latencies_s.append(self.clock.now_s - arrived_s)
        self.count += round(seconds / PERIOD_S)

    @property
    def shed(self) -> int:
        return self.count - len(self.kept)


def test_a_node_that_keeps_the_pace_leaves_nothing_out() -> None:
    queue = Queue()
    queue.run(30.0, 0.9 * PERIOD_S)
    assert queue.shed == 0


def test_a_short_delay_is_made_up_for() -> None:
    queue = Queue()
    queue.run(1.0, 0.3 * PERIOD_S)
    queue.clock.now_s += 0.5
    queue.run(5.0, 0.3 * PERIOD_S)
    assert queue.shed == 0
    assert max(queue.latencies_s) > 0.4


@pytest.mark.parametrize("slowness", [1.5, 2.0, 3.0])
def test_a_node_that_is_too_slow_for_good_keeps_its_latency_and_leaves_out_what_it_cannot_do(slowness: float) -> None:
    queue = Queue()
    queue.run(INTERVAL_S + 2.0, slowness * PERIOD_S)
    settled = len(queue.latencies_s)
    queue.run(20.0, slowness * PERIOD_S)
    assert max(queue.latencies_s[settled:]) < TARGET_S + 2 * slowness * PERIOD_S
    assert len(queue.kept) == pytest.approx(queue.count / slowness, rel=0.1)
    assert queue.kept == sorted(queue.kept)


def test_once_the_machine_is_fast_again_nothing_more_is_left_out() -> None:
    queue = Queue()
    queue.run(10.0, 2.0 * PERIOD_S)
    queue.run(2.0 * INTERVAL_S, 0.5 * PERIOD_S)
    before = queue.shed
    assert before > 0
    queue.run(1.0, 0.5 * PERIOD_S)
    queue.clock.now_s += 0.5
    queue.run(10.0, 0.5 * PERIOD_S)
    assert queue.shed == before


def test_what_goes_in_pairs_leaves_an_alternating_stream() -> None:
    queue = Queue(sheds=2)
    queue.run(20.0, 2.0 * PERIOD_S)
    assert queue.shed > 100
    parities = [index % 2 for index in queue.kept]
    assert parities == [index % 2 for index in range(len(parities))]


def test_what_must_not_be_left_out_never_is() -> None:
    queue = Queue(sheds=0)
    queue.run(10.0, 2.0 * PERIOD_S)
    assert queue.shed == 0
