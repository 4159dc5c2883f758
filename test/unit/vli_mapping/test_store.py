from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest
from mapping_scenes import sheet

from vli_common.errors import OutputError
from vli_common.ply import read_cloud
from vli_mapping.point_map import PointMap
from vli_mapping.store import write_ply


@pytest.fixture
def point_map() -> PointMap:
    point_map = PointMap()
    sheet(point_map, rows=10)
    point_map.refine_normals(point_map.alive(), np.array([0, 0, 1.0]))
    return point_map


def test_a_map_is_read_back_as_it_was_written(point_map: PointMap, tmp_path: Path) -> None:
    cloud = point_map.cloud()
    write_ply(tmp_path / "map.ply", cloud)
    back = read_cloud(tmp_path / "map.ply")
    for name in ("points", "colours", "normals", "weights"):
        np.testing.assert_array_equal(getattr(back, name), getattr(cloud, name))
    assert [path.name for path in tmp_path.iterdir()] == ["map.ply"]


def test_a_file_that_cannot_be_written_leaves_the_old_one(
    point_map: PointMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "map.ply"
    write_ply(path, point_map.cloud())
    before = path.read_bytes()

    def full(*_: object) -> None:
        (tmp_path / "map.ply.partial.ply").write_bytes(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("vli_common.ply.dump_cloud", full)
    with pytest.raises(OutputError, match=f"^'{path}' cannot be written: No space left"):
        write_ply(path, point_map.cloud())
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["map.ply"]


def test_a_directory_that_is_not_there_is_an_error_that_names_the_file(point_map: PointMap, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"absent/map\.ply.*cannot be written"):
        write_ply(tmp_path / "absent" / "map.ply", point_map.cloud())
