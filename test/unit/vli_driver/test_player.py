"""A bag keeps its own pace; a jump of its clock begins a session and no long wait."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from vli_common.types import EncodedImage, ImuSample
from vli_driver.player import BagPlayer

MS = 1_000_000


def images(*stamps_ms: int) -> list[EncodedImage | ImuSample]:
    return [EncodedImage(stamp * MS, b"", "jpeg", compressed=True) for stamp in stamps_ms]


class Log:
    """When each item was handed on."""

    def __init__(self, rate: float = 1.0) -> None:
        self.items: list[tuple[int, float]] = []
        self.jumps: list[tuple[str, int]] = []
        self.player = BagPlayer(rate, self._publish, lambda reason, stamp: self.jumps.append((reason, stamp)))

    def _publish(self, item: EncodedImage | ImuSample) -> None:
        self.items.append((item.stamp_ns, time.monotonic()))

    @property
    def seconds(self) -> list[float]:
        return [at - self.items[0][1] for _, at in self.items]


@pytest.mark.parametrize("rate", [1.0, 4.0])
def test_no_item_is_early_and_the_whole_takes_its_time(rate: float) -> None:
    log = Log(rate)
    assert log.player.play(images(1000, 1020, 1040, 1200))
    expected = [0.0, 0.02 / rate, 0.04 / rate, 0.2 / rate]
    assert all(got >= want - 1e-3 for got, want in zip(log.seconds, expected, strict=True))
    assert log.player.position_ns == 1200 * MS


def test_items_that_cannot_keep_the_pace_are_counted_as_late_but_none_is_left_out() -> None:
    log = Log(100.0)
    slow = BagPlayer(100.0, lambda item: time.sleep(0.15), lambda reason, stamp: None)
    assert slow.play(images(0, 10, 20, 30))
    assert slow.counters["late"] >= 2
    assert log.player.play(images(0, 10))
    assert len(log.items) == 2


def test_a_jump_of_the_clock_is_told_and_not_waited_for() -> None:
    log = Log()
    imu: list[EncodedImage | ImuSample] = [ImuSample(50_000 * MS, np.zeros(3), np.zeros(3))]
    assert log.player.play([*images(50_000, 50_010), *images(1000, 1010), *imu])
    assert log.jumps[0] == ("the clock of the camera jumped by -49.0 s", 1000 * MS)
    assert log.seconds[-1] < 10.0


def test_a_pause_holds_and_is_not_made_up_for() -> None:
    log = Log()
    log.player.pause()
    thread = threading.Thread(target=log.player.play, args=(images(0, 50, 100),))
    thread.start()
    time.sleep(0.1)
    assert log.items == []
    log.player.resume()
    thread.join(20.0)
    assert log.seconds[-1] >= 0.099


def test_a_stop_ends_at_once_also_in_a_gap_or_a_pause() -> None:
    for pause in (False, True):
        log = Log()
        ended: list[bool] = []
        thread = threading.Thread(target=lambda log=log, ended=ended: ended.append(log.player.play(images(0, 9000))))
        if pause:
            log.player.pause()
        thread.start()
        time.sleep(0.05)
        log.player.stop()
        thread.join(20.0)
        assert ended == [False]
