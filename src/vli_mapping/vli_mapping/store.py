"""Files of a map."""

from __future__ import annotations

import os
from pathlib import Path

from vli_common import ply
from vli_common.errors import OutputError
from vli_common.types import PointCloud


def write_ply(path: Path, cloud: PointCloud) -> None:
    """Write a cloud as binary PLY: x y z, nx ny nz (0 = none), red green blue, weight; whole or not at all.

    Raises:
        OutputError: the file cannot be written; what was at ``path`` before is still there.
    """
    partial = path.with_name(f"{path.name}.partial")
    try:
        ply.write_cloud(partial, cloud)
        os.replace(partial, path)
    except OSError as error:
        raise OutputError(f"'{path}' cannot be written: {error.strerror}") from error
    finally:
        _remove(partial)


def _remove(path: Path) -> None:
    """Remove a file that may not be there, in a place that may not let us."""
    try:
        path.unlink(missing_ok=True)
    except OSError:
        return
