from __future__ import annotations

import errno
import os
import resource
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from vli_common.errors import OutputError
from vli_common.ply import read_cloud
from vli_common.types import PointCloud
from vli_mapping.export import CLOUD_WRITERS, write_cloud


@pytest.fixture
def cloud() -> PointCloud:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(
        0,
        rng.uniform(-0.1, 0.1, (500, 3)).astype(np.float32),
        rng.integers(0, 256, (500, 3)).astype(np.uint8),
        normals.astype(np.float32),
        rng.uniform(1, 20, 500).astype(np.float32),
    )


def test_a_ply_is_the_one_of_a_run(cloud: PointCloud, tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.ply", cloud)
    back = read_cloud(tmp_path / "a.ply")
    np.testing.assert_array_equal(back.points, cloud.points)
    np.testing.assert_array_equal(back.colours, cloud.colours)


def test_a_pcd_has_points_normals_and_packed_colours(cloud: PointCloud, tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.pcd", cloud)
    header, _, data = (tmp_path / "a.pcd").read_bytes().partition(b"DATA binary\n")
    assert b"\nWIDTH 500\n" in header
    rows = np.frombuffer(data, "<f4").reshape(500, 8)
    np.testing.assert_array_equal(rows[:, :3], cloud.points)
    np.testing.assert_array_equal(rows[:, 3:6], cloud.normals)
    packed = rows[:, 6].copy().view("<u4")
    np.testing.assert_array_equal(np.stack([packed >> 16, packed >> 8 & 255, packed & 255], axis=1), cloud.colours)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_is_exact_to_a_micrometre_with_colours_and_normals(cloud: PointCloud, tmp_path: Path, suffix: str) -> None:
    laspy = pytest.importorskip("laspy")
    write_cloud(tmp_path / f"a{suffix}", cloud)
    back = laspy.read(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(back.xyz, cloud.points, atol=6e-7)
    np.testing.assert_array_equal(np.stack([back.red, back.green, back.blue], axis=1) // 257, cloud.colours)
    np.testing.assert_array_equal(back.normal_z, cloud.normals[:, 2])


def test_e57_has_points_and_colours(cloud: PointCloud, tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    write_cloud(tmp_path / "a.e57", cloud)
    file = pye57.E57(str(tmp_path / "a.e57"))
    back = file.read_scan(0, colors=True, ignore_missing_fields=True)
    file.close()
    for index, (axis, colour) in enumerate(zip("XYZ", ("Red", "Green", "Blue"), strict=True)):
        np.testing.assert_array_equal(back[f"cartesian{axis}"].astype(np.float32), cloud.points[:, index])
        np.testing.assert_array_equal(back[f"color{colour}"], cloud.colours[:, index])


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".las", ".laz"])
def test_a_full_disk_is_told_by_the_name_that_was_asked_for_and_leaves_the_old_file(
    cloud: PointCloud, tmp_path: Path, suffix: str
) -> None:
    pytest.importorskip("laspy")
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, limits[1]))
    try:
        with pytest.raises(OutputError, match=f"^'{path}' cannot be written: File too large$"):
            write_cloud(path, cloud)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [item.name for item in tmp_path.iterdir()] == [path.name]
    assert path.read_bytes() == b"old"


def test_an_e57_that_finds_no_room_is_one_line_and_leaves_the_old_file(
    cloud: PointCloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pye57")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / "a.e57"
    path.write_bytes(b"old")
    monkeypatch.setattr(shutil, "copyfileobj", full)
    with pytest.raises(OutputError, match=f"^'{path}' cannot be written: No space left on device$"):
        write_cloud(path, cloud)
    assert [item.name for item in tmp_path.iterdir()] == ["a.e57"]
    assert path.read_bytes() == b"old"
    assert capfd.readouterr() == ("", "")


def test_an_unknown_ending_names_those_that_are_known(cloud: PointCloud, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"ends in '\.xyz', expected one of \.ply, \.pcd"):
        write_cloud(tmp_path / "a.xyz", cloud)


@pytest.mark.parametrize("suffix", list(CLOUD_WRITERS))
def test_a_directory_that_is_not_there_is_an_error(cloud: PointCloud, tmp_path: Path, suffix: str) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        write_cloud(tmp_path / "absent" / f"a{suffix}", cloud)


def test_a_missing_library_is_named_with_the_command_that_installs_it(
    cloud: PointCloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(OutputError, match=r"needs 'laspy'.*pip install 'vli_mapping\[export\]'"):
        write_cloud(tmp_path / "a.las", cloud)
    assert not list(tmp_path.iterdir())
