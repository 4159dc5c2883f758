"""PLY files: coloured clouds with normals and weights, and triangle meshes. Binary, little-endian, metres."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError

from vli_common.arrays import AnyArray, ByteArray, Float32Array, FloatArray, IntArray
from vli_common.errors import InputError, OutputError
from vli_common.types import PointCloud

_VERTEX = np.dtype(
    [
        *[(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")],
        *[(name, "u1") for name in ("red", "green", "blue")],
        ("weight", "<f4"),
    ]
)
_NORMAL, _COLOUR = ("nx", "ny", "nz"), ("red", "green", "blue")


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles: vertices (N, 3) metres, faces (M, 3) indices."""

    vertices: FloatArray
    faces: IntArray


def write_cloud(path: Path, cloud: PointCloud) -> None:
    """Write a cloud: x y z, nx ny nz (0 = none), red green blue, weight.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        dump_cloud(path, cloud)
    except OSError as error:
        raise OutputError(f"'{path}' cannot be written: {error.strerror}") from error


def dump_cloud(path: Path, cloud: PointCloud) -> None:
    """Write as :func:`write_cloud` does, for who writes to a name of his own.

    Raises:
        OSError: the file cannot be written.
    """
    rows = np.zeros(len(cloud), _VERTEX)
    _set(rows, ("x", "y", "z"), cloud.points)
    _set(rows, _COLOUR, cloud.colours)
    if cloud.normals is not None:
        _set(rows, _NORMAL, cloud.normals)
    rows["weight"] = 1.0 if cloud.weights is None else cloud.weights
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))


def read_cloud(path: Path) -> PointCloud:
    """Read a cloud; colours are white where the file has none, normals and weights None.

    Raises:
        InputError: no such file, no PLY, or no vertices with x y z.
    """
    vertex = _vertices(path)
    names = vertex.dtype.names or ()
    count = len(vertex)
    has_colour, has_normals = set(_COLOUR) <= set(names), set(_NORMAL) <= set(names)
    colours: ByteArray = _get(vertex, _COLOUR, np.uint8) if has_colour else np.full((count, 3), 255, np.uint8)
    return PointCloud(
        stamp_ns=0,
        points=_get(vertex, ("x", "y", "z"), np.float32),
        colours=colours,
        normals=_get(vertex, _NORMAL, np.float32) if has_normals else None,
        weights=np.array(vertex["weight"], np.float32) if "weight" in names else None,
    )


def read_points(path: Path) -> FloatArray:
    """Return the vertices (N, 3) float64 of any PLY, in the precision of the file.

    Raises:
        InputError: as :func:`read_cloud`.
    """
    return _get(_vertices(path), ("x", "y", "z"), np.float64)


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write a triangle mesh.

    Raises:
        OutputError: the file cannot be written.
    """
    vertex = np.empty(len(mesh.vertices), [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    _set(vertex, ("x", "y", "z"), mesh.vertices)
    face = np.empty(len(mesh.faces), [("vertex_indices", "<i4", (3,))])
    face["vertex_indices"] = mesh.faces
    _write(path, [PlyElement.describe(vertex, "vertex"), PlyElement.describe(face, "face")])


def read_mesh(path: Path) -> Mesh:
    """Read a triangle mesh.

    Raises:
        InputError: no such file, no PLY, no faces, faces that are no triangles or name vertices that are not there.
    """
    data = _read(path)
    vertices = _get(_vertices(path, data), ("x", "y", "z"), np.float64)
    faces: AnyArray = next((element.data for element in data.elements if element.name == "face"), np.empty(0))
    column = next((name for name in faces.dtype.names or () if name in ("vertex_indices", "vertex_index")), None)
    if column is None or not len(faces):
        raise InputError(f"mesh '{path}' has no faces, expected triangles")
    if faces[column].dtype == object and {len(face) for face in faces[column]} != {3}:
        raise InputError(f"mesh '{path}' has faces that are no triangles")
    indices: IntArray = np.stack(list(faces[column])).astype(np.int64)
    if indices.min() < 0 or indices.max() >= len(vertices):
        raise InputError(f"mesh '{path}' has a face of vertex '{indices.max()}', it has '{len(vertices)}' vertices")
    return Mesh(vertices, indices)


def _write(path: Path, elements: list[PlyElement]) -> None:
    try:
        PlyData(elements, byte_order="<").write(str(path))
    except OSError as error:
        raise OutputError(f"'{path}' cannot be written: {error.strerror}") from error


def _read(path: Path) -> PlyData:
    try:
        # Mapped, which takes a known length of the lists: otherwise plyfile reads number by number, seconds for a map.
        return PlyData.read(str(path), mmap=True, known_list_len={"face": {"vertex_indices": 3}})
    except PlyParseError:
        pass
    except OSError as error:
        raise InputError(f"'{path}' cannot be read: {error.strerror or error}") from error
    except (ValueError, UnicodeDecodeError, MemoryError) as error:
        raise InputError(f"'{path}' is no PLY file: {error}") from error
    try:
        return PlyData.read(str(path))
    except (PlyParseError, ValueError, UnicodeDecodeError, MemoryError) as error:
        raise InputError(f"'{path}' is no PLY file: {error}") from error


def _vertices(path: Path, data: PlyData | None = None) -> AnyArray:
    data = data or _read(path)
    for element in data.elements:
        if element.name == "vertex" and {"x", "y", "z"} <= set(element.data.dtype.names or ()):
            rows: AnyArray = element.data
            return rows
    raise InputError(f"'{path}' has no vertices with x, y, z; it has '{', '.join(element.name for element in data.elements)}'")


def _set(rows: AnyArray, names: tuple[str, ...], values: AnyArray | Float32Array) -> None:
    for column, name in enumerate(names):
        rows[name] = values[:, column]


def _get(rows: AnyArray, names: tuple[str, ...], dtype: type) -> AnyArray:
    return np.stack([np.asarray(rows[name], dtype) for name in names], axis=1)
