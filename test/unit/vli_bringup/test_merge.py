from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vli_bringup.cli import EXIT_UNUSABLE, main
from vli_mapping.map_file import load_map, save_map
from vli_mapping.point_map import PointMap, Stripe
from vli_mapping.snapshot import Snapshot, take


def bumps(x0: float, x1: float) -> Snapshot:
    """Return the map of a part of a surface without repetition."""
    point_map = PointMap()
    y = np.arange(-0.01, 0.01, 2.5e-4)
    for number, x in enumerate(np.arange(x0, x1, 4e-4)):
        z = 2e-3 * np.sin(300 * x + 40 * y) * np.cos(350 * y) + 1e-3 * np.sin(9e3 * x * x)
        points = np.stack([np.full_like(y, x), y, z], axis=1)
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[:3, 3] = x, 0.0, 0.03
        zeros, grey = np.zeros((len(y), 3), np.float32), np.full((len(y), 3), 100, np.float32)
        flat, sigma = np.zeros(len(y), np.float32), np.full(len(y), 2e-5)
        point_map.insert(Stripe(number, number, T, points, zeros, flat, grey, sigma, np.ones(len(y), np.bool_)))
    point_map.refine_normals(point_map.alive(), np.array([x0, 0, 0.05]))
    return take(point_map, None)


@pytest.fixture
def maps(tmp_path: Path) -> Path:
    (tmp_path / "scan").mkdir()
    save_map(tmp_path / "scan" / "map.vli", bumps(-0.01, 0.02))
    save_map(tmp_path / "b.vli", bumps(0.005, 0.03))
    save_map(tmp_path / "empty.vli", take(PointMap(), None))
    return tmp_path


def test_results_and_files_are_merged(maps: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["merge", str(maps / "scan"), str(maps / "b.vli"), "--out", str(maps / "all.vli")]) == 0
    text = capsys.readouterr().out
    assert f"'{maps / 'b.vli'}': " in text
    assert "% of the overlap of the same shape, plain, " in text
    merged = load_map(maps / "all.vli")
    assert f"{len(merged)} points in" in text
    assert np.ptp(merged.columns.position[:, 0]) == pytest.approx(0.04, abs=1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["b.vli", "--out", "all.vli"], "is one map, expected two or more"),
        (["b.vli", "scan", "--out", "all.ply"], "ends in '.ply', expected '.vli'"),
        (["b.vli", "absent.vli", "--out", "all.vli"], "absent.vli' cannot be read"),
        (["b.vli", "empty.vli", "--out", "all.vli"], "empty.vli' is empty"),
    ],
)
def test_what_cannot_be_merged_is_one_line(
    maps: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(maps)
    assert main(["merge", *arguments]) == EXIT_UNUSABLE
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (maps / "all.vli").exists()
