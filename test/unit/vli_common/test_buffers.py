"""Buffers: every answer against a plain model that remembers everything."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vli_common.buffers import Found, Never, NotYet, Push, Reason, StampedBuffer


def filled(*stamps: int, **options: object) -> StampedBuffer[str]:
    buffer: StampedBuffer[str] = StampedBuffer(capacity=options.pop("capacity", 100), **options)  # type: ignore[arg-type]
    for stamp in stamps:
        buffer.push(stamp, f"item {stamp}")
    return buffer


def test_an_exact_stamp_is_found_awaited_or_given_up_with_the_reason() -> None:
    buffer = filled(10, 20, 30, capacity=2)
    assert buffer.at(20) == Found(20, "item 20")
    assert buffer.at(25) == Never(Reason.SKIPPED)
    assert buffer.at(10) == Never(Reason.EXPIRED)
    assert buffer.at(35) == NotYet(5)
    assert filled().at(1) == NotYet(None)


def test_the_nearest_item_is_given_only_when_none_closer_can_come() -> None:
    buffer = filled(10, 20)
    assert buffer.nearest(19, within_ns=5) == Found(20, "item 20")
    assert buffer.nearest(22, within_ns=5) == NotYet(2)
    assert buffer.nearest(15, within_ns=2) == Never(Reason.SKIPPED)
    assert filled(10, 20, 30).nearest(22, within_ns=5) == Found(20, "item 20")


def test_an_interval_is_open_at_its_start_closed_at_its_end_and_waits_for_its_end() -> None:
    buffer = filled(10, 20, 30)
    assert buffer.between(10, 30) == Found(30, ["item 20", "item 30"])
    assert buffer.between(10, 15) == Found(15, [])
    assert buffer.between(10, 31) == NotYet(1)
    assert buffer.between(10, 10) == Never(Reason.EMPTY_INTERVAL)
    assert filled(10, 20, 30, capacity=1).between(5, 30) == Never(Reason.EXPIRED)


def test_duplicates_and_late_items_are_told_and_counted() -> None:
    buffer = filled(10, 20)
    assert buffer.push(20, "again") is Push.DUPLICATE
    assert buffer.push(15, "late") is Push.OUT_OF_ORDER
    assert list(buffer) == ["item 10", "item 20"]
    assert (buffer.counters["duplicate"], buffer.counters["out_of_order"]) == (1, 1)
    patient = filled(10, 20, keep_late=True)
    assert patient.push(15, "late") is Push.OUT_OF_ORDER
    assert list(patient) == ["item 10", "late", "item 20"]


def test_the_buffer_never_holds_more_than_its_capacity_nor_older_than_its_horizon() -> None:
    buffer = filled(*range(0, 100, 10), capacity=4)
    assert list(buffer) == ["item 60", "item 70", "item 80", "item 90"]
    assert buffer.counters["evicted"] == 6
    assert filled(0, 10, 20, 500, horizon_ns=490).oldest_ns == 10
    assert buffer.push(5, "ancient") is Push.TOO_OLD


def test_what_was_popped_is_expired_and_a_cleared_buffer_starts_anew() -> None:
    buffer = filled(10, 20, 30)
    assert buffer.pop_until(20) == ["item 10", "item 20"]
    assert buffer.at(20) == Never(Reason.EXPIRED)
    buffer.clear()
    assert buffer.push(5, "new session") is Push.ACCEPTED
    assert buffer.at(20) == NotYet(15)


def test_a_buffer_without_room_is_refused() -> None:
    with pytest.raises(ValueError, match="'0', expected at least 1"):
        StampedBuffer[int](capacity=0)


@given(st.lists(st.integers(0, 60), max_size=40), st.integers(1, 8), st.integers(0, 70), st.booleans())
def test_answers_agree_with_a_list_that_forgets_nothing(stamps: list[int], capacity: int, question: int, keep_late: bool) -> None:
    buffer: StampedBuffer[int] = StampedBuffer(capacity, None, keep_late)
    held: dict[int, int] = {}
    for order, stamp in enumerate(stamps):
        if buffer.push(stamp, order) is Push.ACCEPTED or (keep_late and buffer.at(stamp) == Found(stamp, order)):
            held[stamp] = order
    kept = sorted(held)[-capacity:]
    assert list(buffer) == [held[stamp] for stamp in kept]
    answer = buffer.at(question)
    if question in kept:
        assert answer == Found(question, held[question])
    elif isinstance(answer, NotYet):
        assert not kept or question > kept[-1]
    else:
        assert isinstance(answer, Never)
        assert kept
        assert question < kept[-1]
