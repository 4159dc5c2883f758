"""Directories that a command makes: complete, or not there at all, and never in the place of something else."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import TracebackType

from vli_common.errors import OutputError


class NewDirectory:
    """Context manager: files are written to ``DIR.partial``, which takes the place of ``DIR`` when all went well.

    Args:
        path: of the directory to make.
        marker: file by which a directory of this command is known: only such a one is ever replaced.
        overwrite: True lets it be replaced.

    Raises:
        OutputError: the directory holds something already, is none, or cannot be made; or ``DIR.partial`` holds what must not be
            lost.
    """

    def __init__(self, path: Path, marker: str, overwrite: bool = False) -> None:
        self._marker = marker
        if path.name in ("", ".."):
            raise OutputError(f"'{path}' is no name for a new directory; choose another with --out DIR")
        self.path, self.partial = path, path.with_name(path.name + ".partial")
        try:
            _check(path, marker, overwrite)
        except OSError as error:
            raise OutputError(f"'{path}' cannot be looked at ({error.strerror}); choose another with --out DIR") from error
        if not overwrite and (rest := self.rest()):
            raise OutputError(
                f"'{self.partial}' holds {rest}; rename it, choose another with --out DIR, or replace it with --overwrite"
            )

    def rest(self) -> str:
        """Return what ``DIR.partial`` holds that nobody can make again, in words; empty where that is nothing."""
        return ""

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
        """Move what was written into place, or remove what a failure left."""
        if kind is not None:
            shutil.rmtree(self.partial, ignore_errors=True)
            if isinstance(error, OSError):
                raise OutputError(f"results cannot be written to '{self.partial}' ({error.strerror or error})") from error
            return
        try:
            _remove(self.path)
            self.partial.rename(self.path)
            self.settle()
        except OSError as failure:
            raise OutputError(f"'{self.partial}' cannot be renamed to '{self.path}' ({failure.strerror})") from failure

    def settle(self) -> None:
        """Do what is to follow once the directory is in its place."""


def _check(path: Path, marker: str, overwrite: bool) -> None:
    if path.is_symlink():
        raise OutputError(f"'{path}' is a link, expected a directory; name the one it points at with --out DIR")
    if path.exists() and not path.is_dir():
        raise OutputError(f"'{path}' is a file, expected a directory for the results; choose another with --out DIR")
    there = sorted(item.name for item in path.iterdir()) if path.is_dir() else []
    if there and not overwrite:
        raise OutputError(f"'{path}' is not empty; choose another with --out DIR, or replace it with --overwrite")
    if there and marker not in there:
        raise OutputError(f"'{path}' holds '{there[0]}' but no '{marker}': not results, so --overwrite will not replace it")


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
