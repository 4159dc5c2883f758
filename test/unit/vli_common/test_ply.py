"""PLY files come back as written; what is no PLY is told in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from vli_common import ply
from vli_common.errors import InputError, OutputError
from vli_common.types import PointCloud

RANDOM = np.random.default_rng(5)


def cloud_of(count: int) -> PointCloud:
    points, normals = RANDOM.normal(size=(2, count, 3)).astype(np.float32)
    colours = RANDOM.integers(0, 256, (count, 3)).astype(np.uint8)
    return PointCloud(0, points, colours, normals, RANDOM.integers(1, 9, count).astype(np.float32))


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_a_cloud_comes_back_as_written(tmp_path: Path, count: int) -> None:
    cloud = cloud_of(count)
    ply.write_cloud(tmp_path / "map.ply", cloud)
    again = ply.read_cloud(tmp_path / "map.ply")
    for name in ("points", "colours", "normals", "weights"):
        np.testing.assert_array_equal(getattr(again, name), getattr(cloud, name))
    np.testing.assert_array_equal(ply.read_points(tmp_path / "map.ply"), cloud.points.astype(np.float64))


def test_the_columns_stand_in_the_documented_order_in_binary(tmp_path: Path) -> None:
    ply.write_cloud(tmp_path / "map.ply", cloud_of(3))
    data = PlyData.read(str(tmp_path / "map.ply"))
    assert (data.text, data.byte_order) == (False, "<")
    assert [item.name for item in data["vertex"].properties] == [
        "x",
        "y",
        "z",
        "nx",
        "ny",
        "nz",
        "red",
        "green",
        "blue",
        "weight",
    ]


def test_a_mesh_comes_back_as_written(tmp_path: Path) -> None:
    mesh = ply.Mesh(RANDOM.normal(size=(50, 3)).astype(np.float32).astype(np.float64), RANDOM.integers(0, 50, (80, 3)))
    ply.write_mesh(tmp_path / "mesh.ply", mesh)
    again = ply.read_mesh(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(again.vertices, mesh.vertices)
    np.testing.assert_array_equal(again.faces, mesh.faces)


def test_files_of_others_are_read_in_text_too_with_what_they_have(tmp_path: Path) -> None:
    path = tmp_path / "text.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty double x\nproperty double y\nproperty double z\n"
        "element face 1\nproperty list uchar int vertex_index\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    cloud = ply.read_cloud(path)
    assert (cloud.colours == 255).all()
    assert cloud.normals is None
    np.testing.assert_array_equal(ply.read_mesh(path).faces, [[0, 1, 2]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read"),
        (b"", "no PLY file"),
        (b"hello", "no PLY file"),
        (b"\xff" * 100, "no PLY file"),
        (b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n2\n", "no vertices with x, y, z"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nend_header\n", "no PLY file"),
    ],
)
def test_what_is_no_cloud_is_told(tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / "bad.ply"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        ply.read_cloud(path)


@pytest.mark.parametrize(("faces", "message"), [("4 0 1 2 0", "no triangles"), ("3 0 1 7", "vertex '7', it has '3' vertices")])
def test_a_mesh_with_impossible_faces_is_refused(tmp_path: Path, faces: str, message: str) -> None:
    path = tmp_path / "mesh.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n{faces}\n"
    )
    with pytest.raises(InputError, match=message):
        ply.read_mesh(path)


def test_a_cloud_is_no_mesh(tmp_path: Path) -> None:
    ply.write_cloud(tmp_path / "map.ply", cloud_of(3))
    with pytest.raises(InputError, match="has no faces"):
        ply.read_mesh(tmp_path / "map.ply")


def test_a_place_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        ply.write_cloud(tmp_path / "absent" / "map.ply", cloud_of(1))


def test_the_surface_of_the_recording_is_read(shared_data: Path) -> None:
    mesh = ply.read_mesh(shared_data / "keyboard_short" / "surface.ply")
    assert mesh.faces.shape[1] == 3
    assert np.ptp(mesh.vertices, axis=0).max() < 1.0
