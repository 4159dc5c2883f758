from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vli_common.arrays import FloatArray
from vli_common.errors import OutputError
from vli_common.types import PointCloud
from vli_mapping.mesh import MESH_SUFFIXES, VOXEL_M, ColouredMesh, _joined, make_mesh, write_mesh

pytest.importorskip("skimage")
trimesh = pytest.importorskip("trimesh")

BUMP = 1.5e-3


def height(x: FloatArray, y: FloatArray) -> FloatArray:
    return BUMP * np.exp(-(x**2 + y**2) / 2e-5)


def cloud_of(points: FloatArray, normals: FloatArray) -> PointCloud:
    colours = np.where(points[:, :1] > 0, [[200, 40, 40]], [[40, 40, 200]]).astype(np.uint8)
    return PointCloud(0, points.astype(np.float32), colours, normals.astype(np.float32), np.ones(len(points), np.float32))


def plate(x0: float, x1: float, noise: float = 1e-5) -> PointCloud:
    """Return stripes 0.4 mm apart over a plate with a bump at the origin, 24 mm along y."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(x0, x1, 4e-4), np.arange(-0.012, 0.012, 1e-4)))
    normals = np.stack([height(x, y) * x / 1e-5, height(x, y) * y / 1e-5, np.ones_like(x)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.stack([x, y, height(x, y) + np.random.default_rng(0).normal(size=len(x)) * noise], axis=1)
    return cloud_of(points, normals)


@pytest.fixture(scope="module")
def mesh() -> ColouredMesh:
    left, right = plate(-0.016, -0.004), plate(-0.001, 0.016)
    join = [np.concatenate([getattr(left, name), getattr(right, name)]) for name in ("points", "colours", "normals", "weights")]
    return make_mesh(PointCloud(0, *join))


def test_the_mesh_is_the_surface_and_faces_the_sensor(mesh: ColouredMesh) -> None:
    v = mesh.vertices.astype(float)
    inside = (np.abs(v[:, 1]) < 0.011) & (np.abs(v[:, 0]) < 0.015) & ((v[:, 0] < -0.005) | (v[:, 0] > 0))
    assert np.abs(v[inside, 2] - height(v[inside, 0], v[inside, 1])).max() < 5e-5
    corners = v[mesh.faces]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    assert (facing > 0).mean() > 0.999


def test_no_web_spans_what_was_not_seen(mesh: ColouredMesh) -> None:
    x = mesh.vertices[:, 0]
    assert ((x > -0.004 + 3 * VOXEL_M) & (x < -0.001 - 3 * VOXEL_M)).sum() == 0
    assert np.ptp(x[mesh.faces], axis=1).max() < 2 * VOXEL_M


def test_there_are_no_holes_where_stripes_are_close(mesh: ColouredMesh) -> None:
    corners = mesh.vertices[mesh.faces].astype(float)
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2].sum() / 2
    assert flat == pytest.approx((0.012 + 0.017) * 0.024, rel=0.1)


def test_blocks_are_sewn_together(mesh: ColouredMesh) -> None:
    item = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert item.body_count == 2


def test_a_sliver_that_sewing_makes_a_line_is_no_triangle() -> None:
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1e-5, 0.0]])
    vertices, faces = _joined([(corners, np.array([[0, 1, 2], [0, 1, 3], [1, 3, 2]]))], 1e-3)
    assert len(faces) == 1
    assert set(map(tuple, vertices[faces[0]].tolist())) == {(0.0, 0.0, 0.0), (1e-3, 0.0, 0.0), (0.0, 1e-3, 0.0)}


def test_vertices_have_the_colour_of_the_points_around(mesh: ColouredMesh) -> None:
    right = mesh.vertices[:, 0] > 5e-4
    np.testing.assert_array_equal(np.unique(mesh.colours[right], axis=0), [[200, 40, 40]])


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
def test_every_format_is_read_back(mesh: ColouredMesh, tmp_path: Path, suffix: str) -> None:
    write_mesh(tmp_path / f"mesh{suffix}", mesh)
    back = trimesh.load(tmp_path / f"mesh{suffix}", force="mesh")
    assert len(back.faces) == len(mesh.faces)
    np.testing.assert_allclose(back.bounds, [mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)], atol=1e-6)
    if suffix != ".stl":
        assert {tuple(colour) for colour in np.unique(back.visual.vertex_colors[:, :3], axis=0)} >= {(200, 40, 40), (40, 40, 200)}
    assert [item.name for item in tmp_path.iterdir()] == [f"mesh{suffix}"]


def test_what_has_no_surface_is_an_error() -> None:
    points = np.zeros((10, 3))
    with pytest.raises(OutputError, match="no point of the map has a normal"):
        make_mesh(cloud_of(points, np.zeros((10, 3))))


def test_an_unknown_ending_or_a_missing_directory_is_an_error(mesh: ColouredMesh, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"ends in '\.fbx'"):
        write_mesh(tmp_path / "mesh.fbx", mesh)
    with pytest.raises(OutputError, match="cannot be written"):
        write_mesh(tmp_path / "absent" / "mesh.stl", mesh)
