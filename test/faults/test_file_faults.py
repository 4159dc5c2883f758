"""F25, F26, F28: calibrations and parameters that are wrong, and a disk that takes no more."""

from __future__ import annotations

import math
import resource
from contextlib import contextmanager

import pytest
from tiny_bag import TinyBag, write_calibration

from vli_bringup.cli import main
from vli_bringup.settings import Settings, load_settings
from vli_common.config import parameters
from vli_common.errors import ConfigError, OutputError
from vli_mapping.map_file import load_map, save_map
from vli_mapping.snapshot import take
from vli_mapping.store import write_ply

TWICE = {"resolution": [320, 240], "intrinsics": [240.0, 240.0, 159.5, 119.5]}
"""The camera of the tiny bags at twice their size."""


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return TinyBag(seconds=0.3).write(tmp_path_factory.mktemp("tiny") / "bag")


def test_f25_every_problem_of_a_calibration_is_told_before_anything_starts(tiny, tmp_path, capsys):
    def spoil(document):
        document["laser0"]["plane"] = [0.0, 1.6, -1.2, 0.02]
        document["cam0"]["intrinsics"] = [math.nan, 120.0, 79.5, 59.5]
        del document["imu0"]["gyroscope_noise_density"]
        document["cam0"]["T_cam_imu"][3] = [0.0, 0.0, 0.0, 2.0]
        document["imu0"]["update_rate"] = -1.0

    calibration = write_calibration(tmp_path / "calibration.yaml", spoil)
    assert main(["run", str(tiny), "--calib", str(calibration), "--out", str(tmp_path / "out")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    for said in ("norm", "intrinsics", "gyroscope_noise_density", "T_cam_imu", "update_rate"):
        assert said in lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda d: d["laser0"].update(plane=[0.0, 0.0, 1.0, 0.02]), "behind"),
        (lambda d: d["laser0"].update(plane=[0.0, 0.8, math.inf, 0.02]), "plane"),
        (lambda d: d.pop("cam0"), "cam0"),
        (lambda d: d["cam0"].update(TWICE), "the calibration is for 320 x 240"),
    ],
    ids=["plane behind the camera", "infinite", "no camera", "wrong image size"],
)
def test_f25_a_bad_calibration_is_refused_in_a_line(tiny, tmp_path, capsys, spoil, said):
    calibration = write_calibration(tmp_path / "calibration.yaml", spoil)
    assert main(["run", str(tiny), "--calib", str(calibration), "--out", str(tmp_path / "out")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert said in lines[0]


LIMITED = [
    (f"{stage}.{spec.name}", spec)
    for stage in ("driver", "demux", "stripe", "frontend", "backend", "mapping")
    for spec in parameters(type(getattr(Settings(), stage)))
    if spec.maximum is not None
]


@pytest.mark.parametrize(("name", "spec"), LIMITED, ids=[name for name, _ in LIMITED])
def test_f26_no_parameter_takes_nonsense(name, spec):
    for value in (spec.maximum * 2 + 1, "nan", "many"):
        with pytest.raises(ConfigError, match=spec.name.rsplit(".", maxsplit=1)[-1]):
            load_settings(None, [f"{name}={value}"])


@contextmanager
def full_disk(bytes_left):
    """Let no file grow beyond a size, as a full disk does; the same error to who writes, and no root needed."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (bytes_left, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize("kind", ["map.vli", "map.ply"])
def test_f28_a_map_that_finds_no_room_leaves_what_was_there_and_itself_intact(clean_first_part, tmp_path, kind):
    mapper = clean_first_part.pipeline.stages.mapper
    path = tmp_path / kind

    def save():
        if path.suffix == ".ply":
            write_ply(path, mapper.cloud())
        else:
            save_map(path, take(mapper.map, mapper.light()))

    path.write_bytes(b"the map of yesterday")
    with full_disk(100_000), pytest.raises(OutputError, match=f"'{path}.*' cannot be written: File too large"):
        save()
    assert [item.name for item in tmp_path.iterdir()] == [kind]
    assert path.read_bytes() == b"the map of yesterday"
    save()
    if path.suffix == ".vli":
        assert len(load_map(path)) == len(mapper.map)


def test_f28_a_run_that_finds_no_room_leaves_nothing_and_says_so(demo, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["run", str(demo / "bag"), "--calib", str(demo / "calibration.yaml"), "--out", str(out), "--duration", "2.5"]
    with full_disk(100_000):
        assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "cannot be written" in error
    assert "File too large" in error
    assert list(tmp_path.iterdir()) == []


def test_f28_a_place_that_is_read_only_is_told_before_the_run(tiny, tmp_path, capsys):
    calibration = write_calibration(tmp_path / "calibration.yaml")
    assert main(["run", str(tiny), "--calib", str(calibration), "--out", "/proc/vli/out"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "choose another place with --out DIR" in error
