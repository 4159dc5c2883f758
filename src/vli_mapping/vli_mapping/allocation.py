"""Where the arrays of a map are kept: in memory, or in files of the disk where a map is larger than that."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from vli_common.arrays import AnyArray
from vli_common.errors import OutputError

Allocate = Callable[[tuple[int, ...], DTypeLike], AnyArray]
"""Returns an array of a shape and a type, of undefined content."""


def in_memory(shape: tuple[int, ...], dtype: DTypeLike) -> AnyArray:
    """Return an array in memory."""
    return np.empty(shape, dtype)


def on_disk(directory: Path) -> Allocate:
    """Return what makes arrays in files of a directory, which have no name and go with the last array that is in them.

    The system keeps of them in memory what fits.
    """

    def allocate(shape: tuple[int, ...], dtype: DTypeLike) -> AnyArray:
        count = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        if not count:
            return np.empty(shape, dtype)
        try:
            with tempfile.TemporaryFile(dir=directory) as file:
                # Room is taken now: a disk that is full at a write into a mapped file would end the process.
                os.posix_fallocate(file.fileno(), 0, count)
                # A plain view: compiled code takes it as any other array.
                return np.memmap(file, dtype, "r+", shape=shape).view(np.ndarray)
        except OSError as error:
            raise OutputError(f"'{directory}' has no room for '{count >> 20}' MB of a map: {error.strerror or error}") from error

    return allocate
