"""F29: hours of scanning in one session: what memory, map and error come to where the scanner stays over the same keys."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from runs import Run, Truth, map_in_truth
from streams import Span, Stream, images, shift, there_and_back, until

from vli_bringup.pipeline import Pipeline, Stages
from vli_bringup.settings import Settings
from vli_bringup.tum import read_tum
from vli_common.arrays import FloatArray
from vli_common.calibration import load_calibration
from vli_common.geometry import transform
from vli_common.types import Mode, TrackingState
from vli_driver.bag import BagReader

LAPS = 10
"""Of 50 s each: eight minutes."""
SETTLED = 3
"""Laps after which caches and buffers are full."""
BUFFERS_MB = 40.0
"""What fills up to a limit of its own, and may go on doing so: photographs, sightings of the light, times of the frames."""
GROWTH = 0.015
"""Of the points, a lap at most: what noise and the drift of a few micrometres a lap put beside what is mapped."""
TURN_S = 24.8
"""There the scanner of the recording stands still, to 1 mm/s, so that it can go back the same way."""
REST = Span(0.0, 1.0)
_PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class Lap:
    """What the pipeline has come to at the end of a lap.

    Args:
        states: during it.
        error_mm: RMSE of its live poses, where the first lap lies on the truth.
        memory_mb: of the process's own.
        points, keyframes: of the map.
    """

    states: frozenset[TrackingState]
    error_mm: float
    memory_mb: float
    points: int
    keyframes: int


def resident_mb() -> float:
    """Return the memory of this process that is its own."""
    _, resident, shared, *_ = Path("/proc/self/statm").read_text().split()
    return (int(resident) - int(shared)) * _PAGE / 1e6


def drive(run: Callable[[], Run], lap: Stream, truth: Truth) -> Iterator[Lap]:
    """Go round again and again, on one clock; nothing of what came out of earlier laps is kept."""
    first_ns, last_ns = images(lap)[0].stamp_ns, images(lap)[-1].stamp_ns
    # A lap begins with the image that the one before has ended with.
    seam = [item for item in lap if first_ns < item.stamp_ns <= last_ns]
    T_truth_map: FloatArray | None = None
    for number in range(LAPS):
        by_ns, found = number * (last_ns - first_ns), run()
        for item in seam if number else [item for item in lap if item.stamp_ns <= last_ns]:
            found.add(found.pipeline.push(shift(item, by_ns)))
        live = found.live()
        true = np.stack([truth(int(stamp)) for stamp in live.stamps_ns])
        if T_truth_map is None:
            T_truth_map = map_in_truth(live, truth)
        errors = transform(T_truth_map, live.positions) - true[:, :3, 3]
        point_map = found.pipeline.stages.mapper.map
        yield Lap(
            frozenset(output.state for output in found.outputs),
            1e3 * float(np.sqrt((errors**2).sum(axis=1).mean())),
            resident_mb(),
            len(point_map),
            len(point_map.keyframes),
        )


def truth_of_laps(directory: Path, recording: Stream, lap: Stream) -> Truth:
    """Return where the scanner is at any instant of any lap, in terms of the recording's own time."""
    trajectory = read_tum(directory / "truth.tum")
    poses = dict(zip(trajectory.stamps_ns.tolist(), trajectory.poses, strict=True))
    first_ns = images(recording)[0].stamp_ns
    begin_ns, end_ns = images(lap)[0].stamp_ns, images(lap)[-1].stamp_ns
    rest_ns = end_ns - images(recording)[::2][-1].stamp_ns + first_ns

    def truth(stamp_ns: int) -> FloatArray:
        within_ns = begin_ns + (stamp_ns - begin_ns) % (end_ns - begin_ns)
        return poses[first_ns + abs(within_ns - rest_ns)]

    return truth


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_f29_eight_minutes_over_the_same_keys_in_one_session_add_next_to_nothing(shared_data: Path) -> None:
    directory = shared_data / "keyboard_short"
    calibration = load_calibration(directory / "calibration.yaml")
    recording = until(list(BagReader(directory / "bag")), TURN_S)
    lap = there_and_back(recording, REST)
    pipeline = Pipeline(Stages.create(calibration, Settings(), Mode.VLI_SLAM), Mode.VLI_SLAM)
    laps = list(drive(lambda: Run(calibration, pipeline), lap, truth_of_laps(directory, recording, lap)))
    settled, last = laps[SETTLED], laps[-1]
    told = "\n".join(map(str, laps))
    assert laps[0].states == {TrackingState.INITIALISING, TrackingState.TRACKING}, told
    assert all(item.states == {TrackingState.TRACKING} for item in laps[1:]), told
    assert last.error_mm < 1.5 * settled.error_mm + 0.02, told
    assert max(item.error_mm for item in laps) < 0.2, told
    assert last.memory_mb < settled.memory_mb + BUFFERS_MB, told
    assert last.points < settled.points * (1.0 + GROWTH * (LAPS - 1 - SETTLED)), told
    assert last.keyframes <= 1.03 * settled.keyframes, told
    pipeline.flush()
