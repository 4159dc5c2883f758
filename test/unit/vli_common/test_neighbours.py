"""What nodes say of themselves: restarts are noticed, and two of one name are told, not taken for restarts."""

from __future__ import annotations

import pytest

from vli_common.node.neighbours import Neighbours, News
from vli_common.status import Health, NodeState, StageStatus

SECOND_NS = 1_000_000_000


class Clock:
    """Seconds, set by hand."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def neighbours(clock: Clock) -> Neighbours:
    return Neighbours("demux_node", 50 * SECOND_NS, clock)


def say(clock: Clock, node: str, started_s: int, state: NodeState = NodeState.READY, session: str = "1") -> StageStatus:
    """Return what a node that was started at ``started_s`` says now; the wall clock is that of the test."""
    values = {"session": session} | ({"started_ns": str(started_s * SECOND_NS)} if started_s else {})
    return StageStatus(int(clock.now_s * SECOND_NS), node, Health.OK, state, "", values)


def test_a_node_started_anew_is_news_once(neighbours: Neighbours, clock: Clock) -> None:
    assert neighbours.take(say(clock, "backend_node", 60)) is News.FIRST
    assert neighbours.take(say(clock, "backend_node", 99)) is News.RESTARTED
    assert neighbours.take(say(clock, "backend_node", 99)) is News.KNOWN
    assert neighbours.hint == ""


def test_the_last_words_of_a_killed_node_come_late_and_change_nothing(neighbours: Neighbours, clock: Clock) -> None:
    late = say(clock, "backend_node", 60)
    neighbours.take(say(clock, "backend_node", 60))
    neighbours.take(say(clock, "backend_node", 100))
    assert neighbours.take(late) is News.NAMESAKE
    assert neighbours.statuses["backend_node"].values["started_ns"] == str(100 * SECOND_NS)
    assert neighbours.hint == ""


def test_two_nodes_of_one_name_are_told_and_no_restart_is_seen_after_the_first(neighbours: Neighbours, clock: Clock) -> None:
    news = []
    for _ in range(10):
        news += [neighbours.take(say(clock, "backend_node", started_s)) for started_s in (60, 90)]
        clock.now_s += 1.0
    assert news[:2] == [News.FIRST, News.RESTARTED]
    assert news[2:] == [News.NAMESAKE, News.KNOWN] * 9
    assert neighbours.hint == "'backend_node' runs twice: end one, or give each graph a namespace, or a ROS_DOMAIN_ID"
    clock.now_s += 10.0
    assert neighbours.hint == ""


@pytest.mark.parametrize("started_s", [40, 60])
def test_a_node_notices_that_another_has_its_name(neighbours: Neighbours, clock: Clock, started_s: int) -> None:
    assert neighbours.take(say(clock, "demux_node", 50)) is News.FIRST
    assert neighbours.take(say(clock, "demux_node", started_s)) is News.NAMESAKE
    assert neighbours.statuses["demux_node"].values["started_ns"] == str(50 * SECOND_NS)
    assert "'demux_node' runs twice" in neighbours.hint


def test_a_node_started_anew_after_the_clock_was_set_back_is_heard(neighbours: Neighbours, clock: Clock) -> None:
    neighbours.take(say(clock, "backend_node", 90))
    clock.now_s += 4.0
    assert neighbours.take(say(clock, "backend_node", 30)) is News.RESTARTED


def test_a_name_costs_a_sender_nothing_so_that_their_number_is_limited(neighbours: Neighbours, clock: Clock) -> None:
    news = [neighbours.take(say(clock, f"node{number}", 0)) for number in range(100)]
    assert news == [News.FIRST] * 64 + [News.TOO_MANY] * 36


def test_who_has_finished_has_done_so_in_a_session(neighbours: Neighbours, clock: Clock) -> None:
    neighbours.take(say(clock, "driver_node", 60, NodeState.FINISHED, "2"))
    neighbours.take(say(clock, "backend_node", 60, NodeState.READY, "2"))
    assert list(neighbours.finished(2)) == ["driver_node"]
    assert not neighbours.finished(3)
