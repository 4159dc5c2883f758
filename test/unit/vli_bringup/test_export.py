from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vli_bringup.cli import EXIT_UNUSABLE, main
from vli_common.ply import read_cloud, read_mesh
from vli_common.types import PointCloud
from vli_mapping.light import Light
from vli_mapping.map_file import save_map
from vli_mapping.point_map import PointMap, Stripe
from vli_mapping.snapshot import take
from vli_mapping.store import write_ply


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Return a directory with a map of a plate, as a run leaves it."""
    point_map = PointMap()
    x = np.arange(-0.005, 0.005, 2e-4)
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 0.03
    for number, y in enumerate(np.arange(-0.005, 0.005, 2e-4)):
        points = np.stack([x, np.full_like(x, y), np.zeros_like(x)], axis=1)
        normals, ones = np.tile(np.float32([0, 0, 1]), (len(x), 1)), np.ones(len(x), np.float32)
        grey = np.full((len(x), 3), 90, np.float32)
        point_map.insert(Stripe(number, number, T, points, normals, ones, grey, 3e-5 * np.ones(len(x)), ones > 0))
    light = Light(np.zeros(3), 0.0, (0.0, 0.0), 0.02)
    save_map(tmp_path / "map.vli", take(point_map, light))
    write_ply(tmp_path / "map.ply", point_map.cloud(light=light))
    return tmp_path


def brightness(cloud: PointCloud) -> float:
    near = np.linalg.norm(cloud.points[:, :2], axis=1) < 1e-3
    return float(cloud.colours[near].mean())


@pytest.mark.parametrize("name", [".", "map.vli", "map.ply"])
def test_results_and_either_file_are_exported(results: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(results / name), "--out", str(results / "out.pcd")]) == 0
    assert "2500 points in" in capsys.readouterr().out
    assert (results / "out.pcd").stat().st_size > 2500 * 32


def test_colours_are_without_the_light_or_as_seen(results: Path) -> None:
    shown = {}
    for colour in ("compensated", "lit"):
        assert main(["export", str(results), "--out", str(results / "out.ply"), "--colour", colour]) == 0
        shown[colour] = brightness(read_cloud(results / "out.ply"))
    assert shown["lit"] == pytest.approx(90, abs=1)
    assert shown["compensated"] == pytest.approx(90 * (0.03 / 0.02) ** 2, rel=0.02)


def test_a_mesh_by_its_ending_or_by_option(results: Path) -> None:
    pytest.importorskip("skimage")
    assert main(["export", str(results), "--out", str(results / "out.glb")]) == 0
    assert main(["export", str(results), "--out", str(results / "mesh.ply"), "--mesh", "--voxel", "0.3"]) == 0
    assert len(read_mesh(results / "mesh.ply").faces) > 1000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["map.vli", "--out", "out.dwg"], "ends in '.dwg', expected one of .ply, .pcd"),
        (["map.vli", "--out", "out.las", "--mesh"], "expected one of .ply, .stl"),
        (["absent.vli", "--out", "out.ply"], "absent.vli' cannot be read"),
        (["map.ply", "--out", "out.ply", "--colour", "lit"], "--colour needs"),
        (["map.vli", "--out", "out.ply", "--mesh", "--voxel", "0"], "expected 0.01 to 10 mm"),
        (["map.vli", "--out", "absent/out.ply"], "cannot be written"),
    ],
)
def test_what_cannot_be_is_one_line(
    results: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(results)
    assert main(["export", *arguments]) == EXIT_UNUSABLE
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
