"""What ``vli eval`` reads: clouds, the true surface, passes, summary. Every error is one line that names the file."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vli_bringup.map_metrics import Triangles
from vli_bringup.trajectory_metrics import passes_from_seconds
from vli_common import ply
from vli_common.arrays import IntArray
from vli_common.errors import InputError
from vli_common.types import PointCloud


def read_surface(path: Path) -> Triangles:
    """Read a triangle mesh (PLY) as corners (F, 3, 3) in metres.

    Raises:
        InputError: no such file, not a mesh, or corners that are not finite.
    """
    mesh = ply.read_mesh(path)
    triangles: Triangles = mesh.vertices[mesh.faces]
    if not np.isfinite(triangles).all():
        raise InputError(f"surface '{path}' has corners that are not finite, expected metres")
    return triangles


def read_cloud(path: Path) -> PointCloud:
    """Read a cloud whose points are all finite.

    Raises:
        InputError: no such file, not a PLY file with vertices x, y, z, or points that are not finite.
    """
    cloud = ply.read_cloud(path)
    broken = int((~np.isfinite(cloud.points).all(axis=1)).sum())
    if broken:
        raise InputError(f"cloud '{path}' has '{broken}' points that are not finite, expected metres")
    return cloud


def has_colour(cloud: PointCloud) -> bool:
    """Return False for a cloud that is white all over, as a file without colours is read."""
    return bool((cloud.colours != 255).any())


def read_passes(path: Path) -> IntArray:
    """Read first and last stamp (P, 2), nanoseconds, of each pass from ``{"passes": [[start_s, end_s], …]}``.

    Raises:
        InputError: no such file, or not of this form.
    """
    form = 'expected {"passes": [[start, end], …]} in seconds'
    content = read_json(path, "passes")
    try:
        passes = passes_from_seconds(content["passes"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"passes '{path}' cannot be used ({error!r}), {form}") from error
    wrong = passes[passes[:, 1] <= passes[:, 0]]
    if len(wrong):
        raise InputError(
            f"passes '{path}': a pass starts at '{wrong[0, 0] / 1e9:.3f}' and ends at '{wrong[0, 1] / 1e9:.3f}', {form}"
        )
    return passes


def read_json(path: Path, what: str) -> Mapping[str, Any]:
    """Read a JSON object.

    Raises:
        InputError: no such file, or not a JSON object.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{what} '{path}' cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise InputError(f"{what} '{path}' is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise InputError(f"{what} '{path}' holds '{type(content).__name__}', expected a JSON object")
    return content


def number(content: Mapping[str, Any], key: str) -> float | None:
    """Return ``content[key]`` as a float, or None where it is absent or no finite number."""
    value = content.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)
