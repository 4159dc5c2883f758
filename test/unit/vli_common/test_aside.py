"""Services that take long, beside an executor that goes on."""

from __future__ import annotations

import threading
import time

import pytest

from vli_common.node.aside import Aside


def test_actions_run_one_after_another_and_answer() -> None:
    aside, running, most = Aside("test"), [0], [0]

    def action() -> str:
        running[0] += 1
        most[0] = max(most[0], running[0])
        time.sleep(0.02)
        running[0] -= 1
        return "done"

    futures = [aside.run(action) for _ in range(5)]
    aside.finish(5.0)
    assert [future.result() for future in futures] == ["done"] * 5
    assert most == [1]


def test_what_an_action_raises_is_its_answer() -> None:
    def action() -> str:
        raise ValueError("no")

    aside = Aside("test")
    future = aside.run(action)
    aside.finish(5.0)
    with pytest.raises(ValueError, match="no"):
        future.result()


def test_an_action_that_does_not_end_is_not_waited_for() -> None:
    aside, release = Aside("test"), threading.Event()
    aside.run(lambda: str(release.wait()))
    begin_s = time.monotonic()
    aside.finish(0.05)
    assert time.monotonic() - begin_s < 5.0
    release.set()
