"""A jump of the clock begins a new session; late, lost and swapped frames do not."""

from __future__ import annotations

import pytest

from vli_common.clock import ClockMonitor

S = 1_000_000_000


def jumps(items):
    monitor = ClockMonitor()
    return [monitor.jump(stream, round(stamp * S)) for stream, stamp in items]


def test_a_steady_stream_with_gaps_and_swapped_frames_does_not_jump():
    assert jumps([("camera", stamp) for stamp in (0, 0.1, 0.3, 0.2, 0.4, 9.0, 8.5, 12.0)]) == [None] * 8


@pytest.mark.parametrize(("step", "said"), [(3600, r"the clock of the camera jumped by +3600.0 s"), (-10, "by -10.0 s")])
def test_a_jump_is_told_in_words(step, said):
    answers = jumps([("camera", 100), ("camera", 100 + step), ("camera", 100.1 + step)])
    assert answers[0] is None
    assert said in answers[1].reason
    assert (answers[1].is_repeat, answers[1].counter) == (False, "clock_jump")
    assert answers[2] is None


@pytest.mark.parametrize("again", [100.0, 100.5, 99.5])
def test_a_stream_that_begins_again_where_it_began_is_a_bag_in_a_loop(again):
    answers = jumps([("camera", 100), ("camera", 109), ("camera", 118), ("camera", again), ("camera", 109)])
    assert answers[3].reason.startswith("the camera began again where it had begun, -1")
    assert (answers[3].is_repeat, answers[3].counter) == (True, "played_again")
    assert [answer is None for answer in answers] == [True, True, True, False, True]


def test_all_streams_jump_once():
    answers = jumps([("camera", 100), ("IMU", 100), ("IMU", 10), ("camera", 10), ("IMU", 10.1)])
    assert [answer is not None for answer in answers] == [False, False, True, False, False]


def test_streams_on_clocks_of_their_own_do_not_disturb_each_other():
    assert jumps([("camera", 100), ("IMU", 5), ("camera", 100.1), ("IMU", 5.1)]) == [None] * 4
