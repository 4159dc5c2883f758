"""Whether what one node sends reaches another: told from what both count."""

from __future__ import annotations

from vli_common.reception import Reception


def missed(reception: Reception, seconds: range, sent_hz: int = 30, received: int = 100, session: str = "1") -> list[int]:
    return [reception.missed(session, received, sent_hz * second, float(second)) for second in seconds]


def test_what_was_sent_in_vain_is_counted_from_the_last_time_that_something_came() -> None:
    reception = Reception()
    assert reception.received is None
    assert missed(reception, range(10), received=50)[-1] == 9 * 30
    assert reception.received == 50
    assert missed(reception, range(10, 18), received=51) == [0, 0, 0, 0, 0, 0, 180, 210]


def test_little_that_is_missing_may_be_under_way() -> None:
    assert missed(Reception(), range(20), sent_hz=1) == [0] * 20
    assert missed(Reception(), range(6), sent_hz=1000) == [0] * 6


def test_a_new_session_and_a_sender_that_was_started_again_begin_anew() -> None:
    reception = Reception()
    assert missed(reception, range(8))[-1] > 0
    assert missed(reception, range(8, 13), session="2") == [0] * 5
    reception = Reception()
    assert missed(reception, range(100, 108))[-1] > 0
    assert reception.missed("1", 100, 5, 108.0) == 0
