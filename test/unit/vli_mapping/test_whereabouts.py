from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mapping_scenes import FRAME_NS, calibration
from printed_plate import Plate, apart, turned, unique_print

from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, pose, so3_exp
from vli_common.types import FrameKind, MappingOutput, WindowPoses
from vli_mapping.mapper import Mapper
from vli_mapping.snapshot import Snapshot, take

T_MAP_SESSION = pose(so3_exp(np.array([0.0, 0.0, -0.7])), np.array([0.1, 0.05, -0.02]))
KEYFRAME_FRAMES, WINDOW_KEYFRAMES = 20, 3


@pytest.fixture(scope="module")
def plate() -> Plate:
    return Plate(unique_print())


@pytest.fixture(scope="module")
def earlier(plate: Plate) -> Snapshot:
    return take(plate.point_map(), None)


class Session:
    """A scanner that goes over the plate at 12 mm/s; its mapper gets windows as a back end sends them."""

    def __init__(self, plate: Plate, mapper: Mapper, T_map_session: FloatArray) -> None:
        self.plate, self.mapper, self.T_map_session = plate, mapper, T_map_session
        self.located, self.placement, self.keyframes = True, 0, 0

    def true(self, index: int) -> FloatArray:
        return turned(0.035 + 2e-4 * index, 0.038, 0.3)

    def advance(self) -> MappingOutput:
        """Go on by a keyframe; return what the mapper says of the window."""
        first = self.keyframes * KEYFRAME_FRAMES
        for index in range(first, first + KEYFRAME_FRAMES):
            stamp, T = index * FRAME_NS, self.true(index)
            if index % 2:
                self.mapper.add_scan(self.plate.scan(T, stamp))
            else:
                self.mapper.add_image(self.plate.image(T, stamp))
        self.keyframes += 1
        return self.mapper.add_window(self._window())

    def take_answer(self, output: MappingOutput) -> bool:
        """Move to where the mapper has found the session, as a back end does; return whether it has."""
        if output.relocalisation is None:
            return False
        self.T_map_session = self.T_map_session @ inverse(output.relocalisation.T_map_session)
        self.located, self.placement = True, self.placement + 1
        return True

    def lose(self, T_map_session: FloatArray) -> None:
        """Begin a window anew elsewhere in the same session."""
        self.T_map_session, self.located, self.placement = T_map_session, False, self.placement + 1

    def _window(self) -> WindowPoses:
        newest = (self.keyframes - 1) * KEYFRAME_FRAMES
        oldest = max(0, newest - WINDOW_KEYFRAMES * KEYFRAME_FRAMES)
        frames = np.arange(oldest, newest + 1)
        kinds = np.where(frames % 2, FrameKind.SHORT.value, FrameKind.LONG.value)
        kinds[frames % KEYFRAME_FRAMES == 0] = FrameKind.KEYFRAME.value
        final = frames < newest - (WINDOW_KEYFRAMES - 1) * KEYFRAME_FRAMES
        poses = np.stack([inverse(self.T_map_session) @ self.true(int(k)) for k in frames])
        nothing = np.zeros(len(frames), np.bool_)
        return WindowPoses(
            newest * FRAME_NS, frames * FRAME_NS, kinds.astype(np.uint8), final, nothing, poses, 0, self.located, self.placement
        )


def test_a_session_goes_on_with_an_earlier_map_once_it_has_found_its_place(plate: Plate, earlier: Snapshot) -> None:
    mapper = Mapper(calibration())
    mapper.adopt(earlier)
    session = Session(plate, mapper, T_MAP_SESSION)
    outputs = []
    while not session.take_answer(output := session.advance()):
        outputs.append(output)
        assert len(outputs) < 8
    assert all(item.constraints is None for item in [*outputs, output])
    assert mapper.counters["scans_entered"] == 0
    assert apart(session.T_map_session, np.eye(4), session.true(0)[:3, 3]) < 1e-3
    following = session.advance()
    assert mapper.is_located
    assert following.constraints is not None
    assert np.abs(following.constraints.points_map[:, 2]).max() < 1e-4
    mapper.settle()
    assert mapper.counters["scans_entered"] > 0
    assert mapper.counters["scans_unlocated"] == 0
    assert np.abs(mapper.map.cloud().points[:, 2]).max() < 3e-4


def test_after_a_loss_nothing_enters_until_the_place_is_found_and_then_what_was_held_does(
    plate: Plate, earlier: Snapshot
) -> None:
    mapper = Mapper(calibration())
    mapper.resume(earlier)
    session = Session(plate, mapper, np.eye(4))
    for _ in range(5):
        assert session.advance().relocalisation is None
    mapper.settle()
    entered = mapper.counters["scans_entered"]
    assert entered > 0
    session.lose(pose(so3_exp(np.array([0.0, 0.0, 0.02])), np.array([0.004, -0.006, 0.002])))
    output = session.advance()
    assert output.constraints is None
    assert not mapper.is_located
    mapper.settle()
    assert mapper.counters["scans_entered"] == entered
    for _ in range(6):
        if session.take_answer(output):
            break
        output = session.advance()
    session.advance()
    assert mapper.is_located
    mapper.settle()
    assert mapper.counters["scans_entered"] > entered
    assert np.abs(mapper.map.cloud().points[:, 2]).max() < 3e-4


def test_an_answer_nobody_heard_is_given_again(plate: Plate, earlier: Snapshot) -> None:
    mapper = Mapper(calibration())
    mapper.adopt(earlier)
    session = Session(plate, mapper, T_MAP_SESSION)
    answers = [session.advance().relocalisation is not None for _ in range(10)]
    first = answers.index(True)
    assert answers[first + 1 : first + 6] == [False] * 5
    assert any(answers[first + 6 :])


def test_what_is_held_back_is_bounded_and_what_cannot_be_placed_is_counted(plate: Plate, earlier: Snapshot) -> None:
    mapper = Mapper(calibration())
    mapper.adopt(replace(earlier, keyframes=()))
    session = Session(plate, mapper, T_MAP_SESSION)
    for _ in range(6):
        assert session.advance().relocalisation is None
    assert mapper.counters["relocalisation_without_keyframes"] == 6
    session.lose(np.eye(4))
    session.advance()
    assert mapper.counters["scans_unlocated"] > 0
    assert mapper.counters["scans_entered"] == 0
