"""The summary of the demo; the demo itself is run by test/system."""

from __future__ import annotations

import json

import pytest

from vli_bringup import cli, demo
from vli_bringup.recorder import tum_text
from vli_bringup.tum import read_tum


@pytest.fixture
def results(shared_data, tmp_path):
    """Return results whose poses are the truth of the recording, 1 % too large, and no map."""
    truth = read_tum(shared_data / "keyboard_short" / "truth.tum")
    poses = truth.poses.copy()
    poses[:, :3, 3] *= 1.01
    for name in ("trajectory.tum", "trajectory_final.tum"):
        (tmp_path / name).write_text(tum_text(dict(zip(truth.stamps_ns.tolist(), poses, strict=True))))
    (tmp_path / "summary.json").write_text(json.dumps({"frames_with_pose": 1500, "points": 123456}))
    return tmp_path


def test_the_summary_names_figures_and_files(results, shared_data):
    lines = dict(line.split(":", 1) for line in demo.summarise(shared_data / "keyboard_short", results).splitlines())
    assert lines["error of the live poses"].endswith(" mm RMSE, scale +1.00 %")
    assert lines["map points"].strip() == "123,456"
    assert lines["picture"].strip() == str(results / "cloud.png")
    assert lines["camera path"].strip().endswith("cm, 1500 poses")


def test_a_demo_without_its_bag_says_how_to_make_one(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo, "RECORDING", tmp_path)
    assert cli.main(["demo", "--out", str(tmp_path / "out")]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert "vli simulate keyboard --preset smoke" in line
