"""The file of a whole map, from which it can be used again: a zip of plain arrays and a header; nothing in it is code.

``header.json`` has format, version, number of points and the light on board; each column of the map is a ``.npy`` beside it, and
so is what its keyframes have. The zip's CRC-32 of every entry is checked when it is read. Entries are stored, not compressed: a
map is noise to a compressor.
"""

from __future__ import annotations

import json
import math
import os
import re
import tokenize
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import IO, Any

import numpy as np

from vli_common.arrays import AnyArray, FloatArray
from vli_common.errors import InputError
from vli_mapping.allocation import Allocate, in_memory
from vli_mapping.keyframe_arrays import NAMES as KEYFRAME_ARRAYS
from vli_mapping.keyframe_arrays import pack, unpack
from vli_mapping.light import Light
from vli_mapping.point_map import Columns
from vli_mapping.snapshot import Snapshot
from vli_mapping.store import replacing

FORMAT, VERSION = "vli-map", 3
_WITHOUT_KEYFRAMES, _WITHOUT_ALBEDO = 1, 2
"""The versions before, which are read as well."""
SUFFIX = ".vli"
_HEADER = "header.json"
_EPOCH = (1980, 1, 1, 0, 0, 0)
"""Of every entry: the same map is the same file."""
_VIEWS = "views"
_ALBEDO = {"albedo": (3,), "albedo_weight": (), "albedo_power": ()}
"""What version 3 brought."""
_MAX_HEADER_BYTES = 1 << 16
_QUOTED = 100
"""Characters of a library's message: some quote the file."""
_CHUNK_BYTES, _CHUNK_ROWS = 1 << 20, 1 << 18
"""Read, and looked at, at a time."""
_REACH_M = 1e4
"""A map is of what the laser has reached; beyond, a place has no cell in the hash that points are found by."""
_UNIT = 1.0 + 1e-3
_DAMAGED = (KeyError, ValueError, TypeError, EOFError, RuntimeError, NotImplementedError, OverflowError, MemoryError)


def save_map(path: Path, snapshot: Snapshot) -> None:
    """Write a map, whole or not at all.

    Raises:
        OutputError: the file cannot be written; what was at ``path`` before is still there.
    """
    header = {
        "format": FORMAT,
        "version": VERSION,
        "points": len(snapshot),
        "views": len(snapshot.views),
        "light": None if snapshot.light is None else _light_to_json(snapshot.light),
        "origin": snapshot.origin,
    }
    with replacing(path) as partial, partial.open("wb") as stream:
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
            archive.writestr(zipfile.ZipInfo(_HEADER, _EPOCH), json.dumps(header, indent=1))
            for name, array in _arrays(snapshot):
                with archive.open(zipfile.ZipInfo(f"{name}.npy", _EPOCH), "w", force_zip64=True) as entry:
                    np.lib.format.write_array(entry, array, allow_pickle=False)
        stream.flush()
        os.fsync(stream.fileno())


def load_map(path: Path, allocate: Allocate = in_memory) -> Snapshot:
    """Read a map.

    Args:
        path: of the file.
        allocate: where its points are kept.

    Raises:
        InputError: no such file, no map, of another version, or damaged.
    """
    with _reading(path) as archive:
        header = _read_header(path, archive)
        version = header["version"]
        columns = {name: _read_array(archive, name, allocate) for name in (*_names(version), _VIEWS)}
        if version <= _WITHOUT_ALBEDO:
            columns |= _no_albedo(len(columns["weight"]), allocate)
        has_keyframes = version > _WITHOUT_KEYFRAMES
        keyframes = unpack({name: _read_array(archive, name) for name in KEYFRAME_ARRAYS}) if has_keyframes else ()
        light = None if header["light"] is None else _light_from_json(header["light"])
        return replace(_checked(path, header, columns, light), keyframes=keyframes)


def map_origin(path: Path) -> str:
    """Return the origin of a map, see :class:`Snapshot`, without reading the map; empty where there is none, or no map.

    Raises:
        InputError: a map that cannot be read.
    """
    if not is_map(path):
        return ""
    with _reading(path) as archive:
        return _origin(_read_header(path, archive))


def session_origin(session: int, back_end: str) -> str:
    """Return the origin of a map that was made in a session of a back end."""
    return f"session {session} of {back_end}"


def session_of(path: Path) -> int | None:
    """Return the session of which :func:`session_origin` named the map; None where there is no such map.

    Raises:
        InputError: a map that cannot be read.
    """
    found = re.match(r"session (\d+) of ", map_origin(path))
    return int(found[1]) if found else None


def is_map(path: Path) -> bool:
    """Return True where the file starts like a map of :func:`save_map`; False too where there is none."""
    try:
        return zipfile.is_zipfile(path)
    except OSError:
        return False


@contextmanager
def _reading(path: Path) -> Iterator[zipfile.ZipFile]:
    """Give the open file; what goes wrong in the block is an error of the file."""
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except zipfile.BadZipFile as error:
        raise InputError(
            f"'{path}' is no map or a damaged one ({str(error)[:_QUOTED]}), expected what 'vli run' writes as 'map{SUFFIX}'"
        ) from error
    except OSError as error:
        raise InputError(f"'{path}' cannot be read: {error.strerror or error}") from error
    except (*_DAMAGED, tokenize.TokenError) as error:
        raise InputError(f"map '{path}' is damaged ({str(error)[:_QUOTED]}); save it again") from error


def _names(version: int = VERSION) -> tuple[str, ...]:
    return tuple(item.name for item in fields(Columns) if version > _WITHOUT_ALBEDO or item.name not in _ALBEDO)


def _no_albedo(count: int, allocate: Allocate) -> dict[str, AnyArray]:
    """Return the columns that a map of an earlier version lacks."""
    columns: dict[str, AnyArray] = {name: allocate((count, *shape), np.float32) for name, shape in _ALBEDO.items()}
    for column in columns.values():
        column[:] = 0
    return columns


def _arrays(snapshot: Snapshot) -> Iterator[tuple[str, AnyArray]]:
    yield from ((name, getattr(snapshot.columns, name)) for name in _names())
    yield _VIEWS, snapshot.views
    yield from pack(snapshot.keyframes).items()


def _read_header(path: Path, archive: zipfile.ZipFile) -> dict[str, Any]:
    if _HEADER not in archive.namelist():
        raise InputError(f"'{path}' is no map: it has no '{_HEADER}', expected what 'vli run' writes as 'map{SUFFIX}'")
    info = archive.getinfo(_HEADER)
    if info.compress_type != zipfile.ZIP_STORED or info.file_size > _MAX_HEADER_BYTES:
        raise ValueError(f"its header is compressed, or has '{info.file_size}' bytes")
    header = json.loads(archive.read(info))
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise InputError(f"'{path}' is no map: its header does not say '{FORMAT}'")
    if header.get("version") not in range(_WITHOUT_KEYFRAMES, VERSION + 1):
        raise InputError(
            f"map '{path}' has version '{str(header.get('version'))[:20]}', this program reads "
            f"'{_WITHOUT_KEYFRAMES}' to '{VERSION}'; scan again or update"
        )
    return header


def _read_array(archive: zipfile.ZipFile, name: str, allocate: Allocate = in_memory) -> AnyArray:
    """Return a column; what it says of itself is believed only as far as the file has the bytes for it."""
    info = archive.getinfo(f"{name}.npy")
    if info.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"'{name}' is compressed")
    if info.file_size > Path(str(archive.filename)).stat().st_size:
        raise ValueError(f"'{name}' is longer than the file")
    with archive.open(info) as entry:
        if np.lib.format.read_magic(entry) != (1, 0):
            raise ValueError(f"'{name}' is of another version")
        shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(entry)
        size = info.file_size - entry.tell()
        if dtype.hasobject or is_fortran or math.prod(shape) * dtype.itemsize != size:
            raise ValueError(f"'{name}' is '{dtype}{list(shape)}', which is not what its '{size}' bytes are")
        array = allocate(shape, dtype)
        _fill(entry, array.reshape(-1).view(np.uint8).data)
    return array


def _fill(entry: IO[bytes], target: memoryview) -> None:
    """Read an entry to its end, where its checksum is compared."""
    at = 0
    while chunk := entry.read(_CHUNK_BYTES):
        if at + len(chunk) > len(target):
            break
        target[at : at + len(chunk)] = chunk
        at += len(chunk)
    if at != len(target):
        raise ValueError(f"it has '{at}' bytes where '{len(target)}' should be")


def _checked(path: Path, header: dict[str, Any], arrays: dict[str, AnyArray], light: Light | None) -> Snapshot:
    """Return the snapshot, if every array is what the map would have written."""
    views = arrays.pop(_VIEWS)
    count = len(arrays["weight"]) if arrays["weight"].ndim else -1
    wanted = Columns.empty(0)
    for name, array in arrays.items():
        model: AnyArray = getattr(wanted, name)
        if array.dtype != model.dtype or array.shape != (count, *model.shape[1:]):
            raise InputError(f"map '{path}' is damaged: '{name}' is '{array.dtype}{list(array.shape)}'; save it again")
    columns = Columns(**arrays)
    whole = views.dtype == np.float64 and views.shape[1:] == (3, 4) and count == header.get("points")
    if not whole or (count and not 0 <= columns.seen_by.min() <= columns.seen_by.max() < len(views)):
        raise InputError(f"map '{path}' is damaged: its points and views do not belong together; save it again")
    if not _is_sound(columns, views):
        raise InputError(f"map '{path}' is damaged: it has points that are nowhere, or look like nothing; save it again")
    return Snapshot(columns, views, light, _origin(header))


def _is_sound(columns: Columns, views: FloatArray) -> bool:
    """Return False where a number is none that mapping can have come to."""
    starts = range(0, len(columns.weight), _CHUNK_ROWS)
    pieces = (columns.at(slice(start, start + _CHUNK_ROWS)) for start in starts)
    return bool((np.abs(views) < _REACH_M).all()) and all(_are_sound(piece) for piece in pieces)


def _are_sound(columns: Columns) -> bool:
    sized = (np.abs(columns.position) < _REACH_M).all()
    shaped = (np.abs(columns.normal) <= _UNIT).all() and not np.isinf(columns.planarity).any()
    # Colours may be NaN: of points that no long image saw.
    coloured = not np.isinf(columns.colour).any()
    sums = np.stack([columns.albedo_weight, columns.albedo_power])
    developed = np.isfinite(columns.albedo).all() and np.isfinite(sums).all() and (sums >= 0).all()
    weighed = (columns.weight > 0).all() and np.isfinite(columns.weight).all() and np.isfinite(columns.sigma).all()
    return bool(sized and shaped and coloured and developed and weighed and columns.solid.view(np.uint8).max(initial=0) <= 1)


def _light_to_json(light: Light) -> dict[str, Any]:
    return {
        "position": light.position.tolist(),
        "ambient": light.ambient,
        "vignetting": list(light.vignetting),
        "reference_m": light.reference_m,
    }


def _light_from_json(values: dict[str, Any]) -> Light:
    first, second = map(float, values["vignetting"])
    position = np.array(values["position"], np.float64)
    ambient, reference_m = float(values["ambient"]), float(values["reference_m"])
    if position.shape != (3,) or not np.isfinite([*position, ambient, first, second, reference_m]).all():
        raise ValueError("the light has no place, or no strength")
    return Light(position, ambient, (first, second), reference_m)


def _origin(header: dict[str, Any]) -> str:
    return str(header.get("origin", ""))
