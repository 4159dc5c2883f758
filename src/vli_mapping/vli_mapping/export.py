"""Clouds in the formats of other programs, by the ending of the file: PLY, PCD, LAS, LAZ, E57. Metres."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from vli_common import ply
from vli_common.arrays import AnyArray
from vli_common.errors import OutputError
from vli_common.types import PointCloud
from vli_mapping.optional import optional
from vli_mapping.store import replacing

EXTRA = "export"
_LAS_SCALE_M = 1e-6
_PCD_HEADER = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z normal_x normal_y normal_z rgb weight
SIZE 4 4 4 4 4 4 4 4
TYPE F F F F F F U F
COUNT 1 1 1 1 1 1 1 1
WIDTH {count}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {count}
DATA binary
"""


def write_cloud(path: Path, cloud: PointCloud) -> None:
    """Write a cloud in the format that the file's ending names, whole or not at all.

    Raises:
        OutputError: unknown ending, the library is not installed, or the file cannot be written.
    """
    write = CLOUD_WRITERS.get(path.suffix.lower())
    if write is None:
        raise OutputError(f"'{path}' ends in '{path.suffix}', expected one of {', '.join(CLOUD_WRITERS)}")
    with replacing(path) as partial:
        write(partial, cloud)


def _write_pcd(path: Path, cloud: PointCloud) -> None:
    """Write binary PCD as PCL reads it: the colour is 0x00RRGGBB."""
    columns = [*((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")), ("rgb", "<u4"), ("weight", "<f4")]
    rows = np.zeros(len(cloud), columns)
    for axis, name in enumerate("xyz"):
        rows[name] = cloud.points[:, axis]
        rows[f"n{name}"] = 0 if cloud.normals is None else cloud.normals[:, axis]
    red, green, blue = cloud.colours.astype(np.uint32).T
    rows["rgb"] = red << 16 | green << 8 | blue
    rows["weight"] = 1 if cloud.weights is None else cloud.weights
    path.write_bytes(_PCD_HEADER.format(count=len(cloud)).encode() + rows.tobytes())


def _write_las(path: Path, cloud: PointCloud) -> None:
    """Write LAS 1.4, format 7 (colour of 16 bits), in micrometres; the normal as dimensions of its own; LAZ by the ending."""
    laspy = optional("laspy", EXTRA)
    header = laspy.LasHeader(point_format=7, version="1.4")
    points = cloud.points.astype(np.float64)
    header.offsets = np.floor(points.min(axis=0)) if len(cloud) else np.zeros(3)
    header.scales = np.full(3, _LAS_SCALE_M)
    if cloud.normals is not None:
        header.add_extra_dims([laspy.ExtraBytesParams(name=f"normal_{axis}", type=np.float32) for axis in "xyz"])
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.red, las.green, las.blue = (cloud.colours.astype(np.uint16) * 257).T
    if cloud.normals is not None:
        las.normal_x, las.normal_y, las.normal_z = cloud.normals.T
    # In memory first: what compresses LAZ has errors of its own for a file without room.
    memory = io.BytesIO()
    try:
        las.write(memory, do_compress=path.suffix.lower() == ".laz")
    except laspy.errors.LaspyException as error:
        raise OutputError(
            f"'{path}' cannot be written: {error}; pip install 'vli_mapping[{EXTRA}]' has what LAZ needs"
        ) from error
    # Not by a view of it: one that an error leaves to the collector ends CPython 3.12.1 (gh-111049).
    memory.seek(0)
    with path.open("wb") as stream:
        shutil.copyfileobj(memory, stream)


def _write_e57(path: Path, cloud: PointCloud) -> None:
    """Write one E57 scan with colours, in the frame of the map.

    In memory first: libE57 that finds no room in a file throws again from its destructors, and says so on the terminal.
    """
    pye57 = optional("pye57", EXTRA)
    data: dict[str, AnyArray] = {
        f"cartesian{axis.upper()}": cloud.points[:, index].astype(np.float64) for index, axis in enumerate("xyz")
    }
    data |= {f"color{name}": cloud.colours[:, index].copy() for index, name in enumerate(("Red", "Green", "Blue"))}
    with os.fdopen(os.memfd_create(path.name), "rb") as memory:
        try:
            file = pye57.E57(f"/proc/self/fd/{memory.fileno()}", mode="w")
            try:
                file.write_scan_raw(data)
            finally:
                file.close()
        except pye57.libe57.E57Exception as error:
            raise OSError(0, str(error).splitlines()[0]) from error
        with path.open("wb") as stream:
            shutil.copyfileobj(memory, stream)


CLOUD_WRITERS: dict[str, Callable[[Path, PointCloud], None]] = {
    ".ply": ply.dump_cloud,
    ".pcd": _write_pcd,
    ".las": _write_las,
    ".laz": _write_las,
    ".e57": _write_e57,
}
"""Ending of a file → what writes it."""
