"""Maps that are kept on the disk."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from vli_common.errors import OutputError
from vli_mapping.allocation import on_disk


def test_an_array_on_the_disk_is_like_any_other_and_its_file_has_no_name(tmp_path: Path) -> None:
    array = on_disk(tmp_path)((1000, 3), np.float32)
    array[:] = 7.0
    assert type(array) is np.ndarray
    assert (array.shape, array.dtype, float(array.sum())) == ((1000, 3), np.float32, 21000.0)
    assert list(tmp_path.iterdir()) == []


def test_an_array_without_a_row_needs_no_file(tmp_path: Path) -> None:
    assert on_disk(tmp_path / "absent")((0, 3), np.float64).shape == (0, 3)


def test_a_disk_without_room_is_told_before_anything_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    with pytest.raises(OutputError, match=rf"'{tmp_path}' has no room for '5' MB of a map: No space left on device"):
        on_disk(tmp_path)((700_000,), np.float64)
