"""Motion and scenes that a scanner has little to go by, or too much."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from conftest import REST
from runs import map_in_truth, rmse_mm, run
from simulated import simulate
from streams import Span, at_rest, drop, is_short, paint

from vli_bringup.map_metrics import surface_distances
from vli_common.geometry import so3_exp, transform
from vli_common.types import TrackingState

INITIALISING, TRACKING = TrackingState.INITIALISING, TrackingState.TRACKING
MOVING = {"motion.duration_s": 4.0, "motion.rest_s": 1.0}


@pytest.mark.parametrize("seconds", [10, pytest.param(600, marks=[pytest.mark.slow, pytest.mark.timeout(3000)])])
def test_f15_at_rest_nothing_drifts_and_nothing_grows(recording, scan, seconds):
    stream = at_rest(recording, REST, seconds, seed=15)
    found = scan(stream)
    assert found.states == [INITIALISING, TRACKING]
    positions = found.live(1.0).positions
    assert 1e3 * np.linalg.norm(positions - positions[0], axis=1).max() < 0.2
    mapper = found.pipeline.stages.mapper
    assert len(mapper.map) == 0
    assert found.count("scans_redundant") > 0.9 * found.count("scans")
    assert found.count("keyframes") < seconds / 2 + 5


@pytest.mark.slow
def test_f15_memory_stays_as_it_is_at_rest(recording, calibration):
    run(at_rest(recording, REST, 3, seed=1), calibration)
    sizes = []
    for seconds in (8, 16):
        stream = at_rest(recording, REST, seconds, seed=15)
        tracemalloc.start()
        kept = run(stream, calibration)
        kept.outputs.clear()
        kept.windows.clear()
        sizes.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    assert sizes[1] < 1.05 * sizes[0] + 200_000


def turned_on_the_spot(times, poses):
    """Four degrees to and fro about all axes, about the camera's own centre, until the third second."""
    envelope = _gate(times, 0.0, 3.0, 0.5)
    angles = np.deg2rad([4.0, 3.0, 2.0]) * envelope[:, None] * np.sin(2 * np.pi * times[:, None] * np.array([0.8, 0.5, 0.9]))
    result = poses.copy()
    result[:, :3, :3] = poses[:, :3, :3] @ so3_exp(angles)
    return result


def test_f16_turning_on_the_spot_starts_nothing_and_moving_on_does(calibration):
    recording = simulate("keyboard", 5, {"motion.duration_s": 5.0, "motion.rest_s": 3.0}, turned_on_the_spot)
    begin_s = 0.6
    stream = drop(recording.stream, Span(-1e9, begin_s).mask(recording.stream))
    found = run(stream, recording.calibration)
    assert found.is_finite()
    assert found.states == [INITIALISING, TRACKING]
    started = next(output for output in found.outputs if output.state is TRACKING)
    # Full speed is reached 0.6 s after the third second.
    assert 3.0 - begin_s < found.time_s(started) < 3.0 - begin_s + 1.0
    assert any("px of parallax, 20 are needed: move sideways" in reason for reason in found.reasons)
    assert rmse_mm(found.live(), recording.truth) < 0.1


def shaken(times, poses):
    """Half a centimetre and ten degrees at 3 to 5 Hz, for a second."""
    envelope = _gate(times, 2.0, 3.0, 0.15)
    angles = np.deg2rad([10.0, 7.0, 0.0]) * envelope[:, None] * np.sin(2 * np.pi * times[:, None] * np.array([3.0, 5.0, 0.0]))
    result = poses.copy()
    result[:, :3, 3] += (5e-3 * envelope * np.sin(2 * np.pi * 4 * times))[:, None] * poses[:, :3, 0]
    result[:, :3, :3] = poses[:, :3, :3] @ so3_exp(angles)
    return result


def test_f17_a_fast_shake_puts_nothing_wrong_into_the_map():
    recording = simulate("keyboard", 5, MOVING, shaken)
    found = run(recording.stream, recording.calibration)
    assert found.is_finite()
    assert found.outputs[-1].state is TRACKING
    assert found.states[:2] == [INITIALISING, TRACKING]
    points = found.pipeline.stages.mapper.cloud().points.astype(np.float64)
    off = surface_distances(transform(map_in_truth(found.live(), recording.truth), points), recording.triangles)
    assert (off.to_point < 1e-3).all()
    # Stripes lie between long frames 33 ms apart; straight lines between those would put 3 % off.
    assert (off.to_point > 5e-4).mean() < 0.015


@pytest.mark.parametrize("scene", ["plate", pytest.param("bar", marks=pytest.mark.slow)])
def test_f20_on_a_surface_without_relief_nothing_slides(scene):
    recording = simulate(scene, 20, {**MOVING, "motion.duration_s": 5.0})
    found = run(recording.stream, recording.calibration)
    assert found.is_finite()
    assert found.states == [INITIALISING, TRACKING]
    # Images of 320 × 240 show few features on a bar; what would slide, slides by millimetres.
    assert rmse_mm(found.live(), recording.truth) < 0.2
    live, true = found.live().positions, np.stack([recording.truth(int(s))[:3, 3] for s in found.live().stamps_ns])
    lengths = [np.linalg.norm(path[-1] - path[0]) for path in (live, true)]
    assert lengths[0] == pytest.approx(lengths[1], rel=0.01)


@pytest.mark.slow
def test_f19_something_that_has_been_moved_does_not_move_the_scanner(revisit, truth_of_revisit, surface, scan):
    """On the way back a third of the stripe lies where a part was lifted by the better part of a millimetre."""

    def lifted(pixels):
        result = pixels.copy()
        result[:, 200:400] = np.roll(pixels, 6, axis=0)[:, 200:400]
        return result

    found = scan(paint(revisit, is_short(revisit) & Span(9.5, 11.0).mask(revisit), lifted))
    assert found.states == [INITIALISING, TRACKING]
    assert found.count("constraints_matched") > 1000
    assert rmse_mm(found.live(), truth_of_revisit) < 0.15


def _gate(times, begin_s, end_s, ramp_s):
    """One between two instants, with smooth ramps of that length within them; zero outside."""
    share = np.clip((times - begin_s) / ramp_s, 0, 1) * np.clip((end_s - times) / ramp_s, 0, 1)
    return share * share * (3 - 2 * share)
