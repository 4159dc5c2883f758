"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vli_common import ply
from vli_common.errors import OutputError
from vli_common.types import PointCloud


def write_ply(path: Path, cloud: PointCloud) -> None:
    """Write a cloud as binary PLY: x y z, nx ny nz (0 = none), red green blue, weight; whole or not at all.

    Raises:
        OutputError: the file cannot be written; what was at ``path`` before is still there.
    """
    with replacing(path) as partial:
        ply.dump_cloud(partial, cloud)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a path to write to, which takes the place of ``path`` when the block ends well, and is removed when not.

    Raises:
        OutputError: the block raised an ``OSError`` (no such directory, disk full), or the file cannot be renamed.
    """
    # The ending stays: libraries choose the format by it.
    partial = path.with_name(f"{path.name}.partial{path.suffix}")
    check_place(path)
    try:
        yield partial
        os.replace(partial, path)
    except OSError as error:
        raise OutputError(f"'{path}' cannot be written: {error.strerror or error}") from error
    finally:
        _remove(partial)


def check_place(path: Path) -> None:
    """Raise, before anything is computed, where a file cannot be written to ``path``.

    Raises:
        OutputError: its directory is not there, or it is one itself.
    """
    try:
        if path.is_dir():
            raise OutputError(f"'{path}' is a directory, expected the file to write")
        if not path.parent.is_dir():
            raise OutputError(f"'{path}' cannot be written: there is no directory '{path.parent}'; make it first")
    except OSError as error:
        raise OutputError(f"'{path}' cannot be written: {error.strerror or error}") from error


def _remove(path: Path) -> None:
    """Remove a file that may not be there, in a place that may not let us."""
    try:
        path.unlink(missing_ok=True)
    except OSError:
        return
