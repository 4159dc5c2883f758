"""``vli run`` on the recording: what it writes, that it repeats itself, that it stops cleanly."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
import time
from functools import partial

import numpy as np
import pytest

from vli_bringup.cli import main
from vli_bringup.settings import Settings, load_settings
from vli_bringup.timing import STAGES
from vli_bringup.tum import read_tum

SUMMARY_KEYS = {
    "frames_long", "frames_short", "keyframes", "points", "states", "startup_s", "wall_s", "cpu_s", "realtime_factor",
    "ms_per_frame_mean", "ms_per_frame_p95",
}  # fmt: skip
FILES = {
    "trajectory.tum", "trajectory_final.tum", "covariance.csv", "map.ply", "map.vli", "cloud.png", "timing.csv", "config.yaml",
    "summary.json",
}  # fmt: skip
DURATION_S = 7.0


@pytest.fixture(scope="session")
def scan(shared_data):
    """Return a function that runs the recording and returns the exit code."""
    recording = shared_data / "keyboard_short"

    def run(out, *options):
        arguments = ["run", str(recording / "bag"), "--calib", str(recording / "calibration.yaml"), "--out", str(out)]
        return main([*arguments, *options])

    return run


@pytest.fixture(scope="session")
def results(scan, tmp_path_factory):
    """Return the results of the first seconds of the recording."""
    out = tmp_path_factory.mktemp("run") / "first"
    assert scan(out, "--duration", str(DURATION_S)) == 0
    return out


@pytest.fixture(scope="session")
def summary(results):
    return json.loads((results / "summary.json").read_text())


def test_a_run_writes_everything_it_promises_and_nothing_else(results, summary):
    assert {item.name for item in results.iterdir()} == FILES
    assert set(summary) == SUMMARY_KEYS
    # The time counts from the first message, which is the IMU's, 0.1 s before the first image.
    assert (summary["frames_long"], summary["frames_short"]) == (207, 207)


def test_two_runs_are_byte_identical(scan, results, tmp_path):
    assert scan(tmp_path / "second", "--duration", str(DURATION_S)) == 0
    for name in FILES - {"timing.csv", "summary.json"}:
        assert (tmp_path / "second" / name).read_bytes() == (results / name).read_bytes(), name


def test_a_live_pose_depends_on_nothing_later(scan, results, tmp_path):
    assert scan(tmp_path / "shorter", "--duration", str(DURATION_S - 2)) == 0
    shorter = (tmp_path / "shorter" / "trajectory.tum").read_text()
    assert shorter.count("\n") > 30
    assert (results / "trajectory.tum").read_text().startswith(shorter)


def test_stamps_are_those_of_the_images_bit_for_bit(results, shared_data):
    stamps = {line.split()[0] for line in (results / "trajectory.tum").read_text().splitlines()}
    truth = (shared_data / "keyboard_short" / "truth.tum").read_text().splitlines()
    assert stamps <= {f"{float(line.split()[0]):.9f}" for line in truth if not line.startswith("#")}


def test_the_final_trajectory_has_the_frames_of_the_live_one_nearby(results):
    live, final = read_tum(results / "trajectory.tum"), read_tum(results / "trajectory_final.tum")
    np.testing.assert_array_equal(live.stamps_ns, final.stamps_ns)
    assert np.abs(live.positions - final.positions).max() < 5e-3


def test_timing_has_a_row_a_long_frame_and_makes_up_the_summary(results, summary):
    """Camera and map have their own threads: a frame takes no less than the main thread's back end, and less than all stages."""
    rows = list(csv.DictReader((results / "timing.csv").open()))
    assert len(rows) == summary["frames_long"]
    totals = [float(row["total_ms"]) for row in rows]
    by_stage = {stage: np.array([float(row[f"{stage}_ms"]) for row in rows]) for stage in STAGES}
    # The camera's thread makes ready what the front end follows.
    assert (totals > by_stage["backend"] - 0.01).all()
    assert np.mean(totals) < np.mean(sum(by_stage.values()))
    assert np.mean(totals) == pytest.approx(summary["ms_per_frame_mean"], abs=0.01)
    assert sum(totals) < 1e3 * summary["wall_s"]


def test_the_parameters_as_used_can_be_given_back(results):
    assert load_settings(results / "config.yaml") == Settings()


def test_the_map_is_where_the_summary_says(results, summary):
    head = (results / "map.ply").read_bytes()[:400].split(b"end_header")[0].decode()
    assert "format binary_little_endian 1.0" in head
    assert f"element vertex {summary['points']}" in head
    names = [line.split()[-1] for line in head.splitlines() if line.startswith("property")]
    assert names == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "weight"]


def test_the_states_say_when_tracking_began(summary):
    assert [state for _, state, _ in summary["states"]][-1] == "TRACKING"
    assert 99.0 < summary["states"][-1][0] < 104.0


@pytest.mark.parametrize("mode", ["vli-odom", "vi"])
def test_the_other_modes_run(scan, tmp_path, mode):
    assert scan(tmp_path / mode, "--duration", "6", "--mode", mode) == 0
    points = json.loads((tmp_path / mode / "summary.json").read_text())["points"]
    assert (points == 0) == (mode == "vi")


def test_an_interrupt_stops_the_run_at_once_and_leaves_nothing(shared_data, tmp_path):
    recording = shared_data / "keyboard_short"
    command = [sys.executable, "-m", "vli_bringup.cli", "run", recording / "bag", "--calib", recording / "calibration.yaml"]
    # Who runs the tests in the background of a shell hands on an ignored SIGINT.
    listen = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen([*command, "--out", tmp_path / "out"], stderr=subprocess.PIPE, text=True, preexec_fn=listen)
    while not (tmp_path / "out.partial").exists() and process.poll() is None:
        time.sleep(0.05)
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=20)
    assert (process.returncode, errors) == (130, "vli: interrupted\n")
    assert list(tmp_path.iterdir()) == []


def test_progress_is_not_shown_in_a_pipe(scan, tmp_path, capfd):
    assert scan(tmp_path / "out", "--duration", "3") in (0, 1)
    assert "\r" not in capfd.readouterr().err
