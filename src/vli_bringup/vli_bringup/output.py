"""The results directory: complete or not there at all."""

from __future__ import annotations

import os
import shutil
from datetime import datetime
from pathlib import Path
from types import TracebackType

from vli_common.errors import OutputError

SUMMARY = "summary.json"
CONFIG = "config.yaml"
_DEFAULT_ROOT = Path("results")
_LATEST = "latest"


class ResultsDirectory:
    """Context manager: files are written to ``DIR.partial``, which takes the place of ``DIR`` when all went well.

    Args:
        out: where the results go; None is ``results/STAMP``, and then the link ``results/latest`` points there.
        overwrite: True lets the results of an earlier run be replaced; a directory that holds anything else is never replaced.

    Raises:
        OutputError: ``out`` holds something already, or cannot be written.
    """

    def __init__(self, out: Path | None, overwrite: bool = False) -> None:
        self.path = out if out is not None else _DEFAULT_ROOT / datetime.now().strftime("%Y%m%d-%H%M%S")
        self.partial = self.path.with_name(self.path.name + ".partial")
        self._is_default = out is None
        _check(self.path, overwrite)

    def __enter__(self) -> Path:
        """Return the directory to write to."""
        try:
            _remove(self.partial)
            self.partial.mkdir(parents=True)
        except OSError as error:
            raise OutputError(
                f"'{self.partial}' cannot be made ({error.strerror}); choose another place with --out DIR"
            ) from error
        return self.partial

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Move the results into place, or remove what a failed run left."""
        if kind is not None:
            shutil.rmtree(self.partial, ignore_errors=True)
            if isinstance(error, OSError):
                raise OutputError(f"results cannot be written to '{self.partial}' ({error.strerror or error})") from error
            return
        try:
            _remove(self.path)
            self.partial.rename(self.path)
            if self._is_default:
                _link(self.path)
        except OSError as failure:
            raise OutputError(f"'{self.partial}' cannot be renamed to '{self.path}' ({failure.strerror})") from failure


def _check(path: Path, overwrite: bool) -> None:
    if path.exists() and not path.is_dir():
        raise OutputError(f"'{path}' is a file, expected a directory for the results; choose another with --out DIR")
    there = sorted(item.name for item in path.iterdir()) if path.is_dir() else []
    if there and not overwrite:
        raise OutputError(f"'{path}' is not empty; choose another with --out DIR, or replace it with --overwrite")
    if there and SUMMARY not in there:
        raise OutputError(f"'{path}' holds '{there[0]}' but no '{SUMMARY}': not results, so --overwrite will not replace it")


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)


def _link(path: Path) -> None:
    """Point ``results/latest`` at ``path``, without a moment in which it is missing."""
    fresh = path.with_name(f".{_LATEST}-{os.getpid()}")
    fresh.symlink_to(path.name)
    fresh.replace(path.with_name(_LATEST))
