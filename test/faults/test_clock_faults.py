"""F13: a clock that is set while the scanner runs."""

from __future__ import annotations

import json

import numpy as np
import pytest
from bags import write_bag
from runs import rmse_mm
from streams import Span, change, shift

from vli_bringup.cli import main
from vli_bringup.tum import read_tum
from vli_common import ply
from vli_common.types import NANOSECONDS, TrackingState

JUMP_S = 2.5
INITIALISING, TRACKING = TrackingState.INITIALISING, TrackingState.TRACKING


AHEAD = pytest.param(3600, id="an hour ahead", marks=pytest.mark.slow)
BACK = pytest.param(-10, id="ten seconds back")


@pytest.mark.parametrize("by_s", [AHEAD, BACK])
def test_f13_a_jump_of_the_stamps_begins_a_session_within_a_frame(first_part, truth, scan, by_s):
    by_ns = by_s * NANOSECONDS
    found = scan(change(first_part, Span(JUMP_S).mask(first_part), lambda item: shift(item, by_ns)))
    assert found.states == [INITIALISING, TRACKING, INITIALISING, TRACKING]
    assert found.pipeline.counters["sessions"] == 1
    assert found.count("clock_jump") == 1
    assert found.count("missing") == 0
    jumped = next(
        k for k, output in enumerate(found.outputs) if abs(found.time_s(output)) > JUMP_S + 5 or found.time_s(output) < 0
    )
    assert found.outputs[jumped].state is INITIALISING
    assert sum(output.state is INITIALISING for output in found.outputs[jumped:]) < 0.8 * 30
    again = found.live(by_s + JUMP_S - 0.1, by_s + 10)
    assert len(again) > 20
    assert rmse_mm(again, lambda stamp_ns: truth(stamp_ns - by_ns)) < 0.05
    sessions = {output.pose.session for output in found.outputs if output.pose is not None}
    assert sessions == {0, 1}


def test_f13_what_was_scanned_before_the_jump_is_kept_beside_the_rest(first_part, demo, tmp_path, capsys):
    jumped = change(first_part, Span(JUMP_S).mask(first_part), lambda item: shift(item, -10 * NANOSECONDS))
    bag, out = write_bag(tmp_path / "bag", jumped), tmp_path / "out"
    assert main(["run", str(bag), "--calib", str(demo / "calibration.yaml"), "--out", str(out)]) == 0
    warning = f"warning: the clock jumped, and what was scanned before is in '{out / 'session-1'}'; join the maps with: vli merge"
    assert warning in capsys.readouterr().err
    for directory in (out / "session-1", out):
        assert len(read_tum(directory / "trajectory.tum")) > 20
        assert len(read_tum(directory / "trajectory_final.tum")) > 20
        assert len(ply.read_cloud(directory / "map.ply").points) > 3000
        assert (directory / "map.vli").is_file()
    last = read_tum(out / "trajectory.tum").stamps_ns
    assert np.all(np.diff(last) > 0)
    assert last[0] < read_tum(out / "session-1" / "trajectory.tum").stamps_ns[0]
    states = [state for _, state, _ in json.loads((out / "summary.json").read_text())["states"]]
    assert states == ["INITIALISING", "TRACKING", "INITIALISING", "TRACKING"]
