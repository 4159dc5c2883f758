"""The pictures of the README, from the bag in ``bags/``: ``make pictures``.

    python docs/pictures.py [OUT]

``demo.png`` is the ``cloud.png`` of the scan, ``mesh.png`` the same views of the mesh that ``vli export`` makes of it.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import trimesh

from vli_bringup.cli import main as vli
from vli_common.arrays import ByteArray
from vli_common.types import PointCloud
from vli_mapping.render import draw_views

DEMO = Path(__file__).resolve().parents[1] / "bags" / "demo"
SIZE = 1600, 1000
_SAMPLES = 1_500_000
"""Points on the mesh: so dense that they close at two to a pixel."""


def main(out: Path) -> None:
    """Scan, mesh, draw."""
    with tempfile.TemporaryDirectory() as name:
        scan = Path(name)
        run("run", DEMO / "bag", "--calib", DEMO / "calibration.yaml", "--out", scan / "out")
        run("export", scan / "out", "--mesh", "--out", scan / "mesh.ply")
        cloud = cv2.imread(str(scan / "out" / "cloud.png"))
        if cloud is None:
            sys.exit("vli run has written no picture")
        mesh = draw_mesh(scan / "mesh.ply")
    out.mkdir(parents=True, exist_ok=True)
    write(out / "demo.png", np.asarray(cloud, np.uint8))
    write(out / "mesh.png", mesh)


def run(*args: object) -> None:
    """Run a ``vli`` command, or end with its exit code."""
    if code := vli([str(arg) for arg in args]):
        sys.exit(code)


def draw_mesh(path: Path) -> ByteArray:
    """Return the three views (H, W, 3) BGR of a mesh, drawn as points all over its triangles."""
    mesh = trimesh.load_mesh(path, process=False)
    points, triangles = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=0)
    corners = np.asarray(mesh.visual.vertex_colors)[mesh.faces[triangles]]
    colours = corners[:, :, :3].mean(axis=1).astype(np.uint8)
    normals = mesh.face_normals[triangles].astype(np.float32)
    cloud = PointCloud(0, np.asarray(points, np.float32), colours, normals)
    return draw_views(cloud, caption=f"{len(mesh.faces):,} triangles".replace(",", " "))


def write(path: Path, picture: ByteArray) -> None:
    """Write a picture, smaller, so that the page loads at once."""
    small = cv2.resize(picture, SIZE, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), small, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "images")
