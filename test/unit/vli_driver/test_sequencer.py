"""The exposure sequencer against a camera and a laser that write down what they are told."""

from __future__ import annotations

import pytest

from vli_common.errors import ConfigError
from vli_common.types import Exposure
from vli_driver.sequencer import Sequencer, Shot
from vli_driver.sources import LaserSwitch, TriggeredCamera

PERIOD_NS = 10_000_000
DELAY_NS = 4_000_000


class Recorder:
    """Camera and laser in one, so that the order of the commands shows."""

    def __init__(self) -> None:
        self.commands: list[tuple[str, float]] = []

    def trigger(self, exposure_s: float) -> None:
        self.commands.append(("trigger", exposure_s))

    def set_laser(self, on: bool) -> None:
        self.commands.append(("laser", on))


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()


@pytest.fixture
def sequencer(recorder: Recorder) -> Sequencer:
    return Sequencer(recorder, recorder, rate_hz=100.0, exposure_long_s=5e-3, exposure_short_s=3e-4)


def shot_at(sequencer: Sequencer, slot: int, late_ns: int = 0) -> Shot:
    shot = sequencer.tick(slot * PERIOD_NS + late_ns)
    assert shot is not None
    return shot


def test_the_recorder_is_what_the_protocols_ask_for(recorder: Recorder) -> None:
    assert isinstance(recorder, TriggeredCamera)
    assert isinstance(recorder, LaserSwitch)


def test_long_and_short_alternate_and_the_laser_is_switched_before_each_exposure(
    sequencer: Sequencer, recorder: Recorder
) -> None:
    kinds = [shot_at(sequencer, slot).exposure for slot in range(4)]
    assert kinds == [Exposure.LONG, Exposure.SHORT] * 2
    assert recorder.commands == [("laser", False), ("trigger", 5e-3), ("laser", True), ("trigger", 3e-4)] * 2


def test_stamps_are_at_mid_exposure(sequencer: Sequencer) -> None:
    assert shot_at(sequencer, 0).stamp_ns == 2_500_000
    assert shot_at(sequencer, 1, late_ns=7).stamp_ns == PERIOD_NS + 7 + 150_000


def test_a_slot_is_exposed_once(sequencer: Sequencer) -> None:
    shot_at(sequencer, 0)
    assert sequencer.tick(PERIOD_NS - 1) is None
    assert sequencer.next_tick_ns(PERIOD_NS - 1) == PERIOD_NS


@pytest.mark.parametrize("missed", [1, 2, 7])
def test_missed_triggers_do_not_swap_long_and_short(sequencer: Sequencer, missed: int) -> None:
    shot_at(sequencer, 0)
    shot = shot_at(sequencer, 1 + missed)
    assert shot.exposure is (Exposure.LONG if (1 + missed) % 2 == 0 else Exposure.SHORT)
    assert sequencer.counters["missed_slots"] == missed


@pytest.mark.parametrize("lost", [0, 1, 2, 3])
def test_lost_images_do_not_shift_what_the_next_one_is_taken_for(sequencer: Sequencer, lost: int) -> None:
    shots = [shot_at(sequencer, slot) for slot in range(6)]
    assert sequencer.on_image(shots[0].end_ns + DELAY_NS) == shots[0]
    assert sequencer.on_image(shots[1 + lost].end_ns + DELAY_NS) == shots[1 + lost]
    assert sequencer.counters["lost_images"] == lost


def test_an_image_that_nobody_asked_for_has_no_shot(sequencer: Sequencer) -> None:
    assert sequencer.on_image(0) is None
    shot = shot_at(sequencer, 0)
    assert sequencer.on_image(shot.end_ns - PERIOD_NS) is None
    assert sequencer.on_image(shot.end_ns - DELAY_NS) == shot
    assert sequencer.counters["unknown_images"] == 2


def test_shots_whose_images_never_come_do_not_pile_up(sequencer: Sequencer) -> None:
    for slot in range(100):
        shot_at(sequencer, slot)
    assert sequencer.counters["lost_images"] == 92


def test_the_laser_is_off_after_stop_and_the_next_shot_is_long(sequencer: Sequencer, recorder: Recorder) -> None:
    shot_at(sequencer, 0)
    shot_at(sequencer, 1)
    sequencer.stop()
    assert recorder.commands[-1] == ("laser", False)
    assert shot_at(sequencer, 5).exposure is Exposure.LONG


@pytest.mark.parametrize(("rate_hz", "exposure_s"), [(0.0, 1e-3), (60.0, 0.02), (60.0, 0.0)])
def test_exposures_that_do_not_fit_the_period_are_refused(recorder: Recorder, rate_hz: float, exposure_s: float) -> None:
    with pytest.raises(ConfigError, match="expected more than 0 s"):
        Sequencer(recorder, recorder, rate_hz, exposure_s, 1e-5 if exposure_s else 0.0)
