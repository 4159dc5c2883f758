"""The results directory: complete or not there at all."""

from __future__ import annotations

import os
from datetime import datetime
from pathlib import Path

from vli_common.directories import NewDirectory

SUMMARY = "summary.json"
CONFIG = "config.yaml"
_DEFAULT_ROOT = Path("results")
_LATEST = "latest"


class ResultsDirectory(NewDirectory):
    """Context manager: files are written to ``DIR.partial``, which takes the place of ``DIR`` when all went well.

    Args:
        out: where the results go; None is ``results/STAMP``, and then the link ``results/latest`` points there.
        overwrite: True lets the results of an earlier run be replaced; a directory that holds anything else is never replaced.

    Raises:
        OutputError: ``out`` holds something already, or cannot be written.
    """

    def __init__(self, out: Path | None, overwrite: bool = False) -> None:
        self._is_default = out is None
        super().__init__(_DEFAULT_ROOT / datetime.now().strftime("%Y%m%d-%H%M%S") if out is None else out, SUMMARY, overwrite)

    def settle(self) -> None:
        """Point ``results/latest`` at a directory of its own naming."""
        if self._is_default:
            _link(self.path)


def _link(path: Path) -> None:
    """Point ``results/latest`` at ``path``, without a moment in which it is missing."""
    fresh = path.with_name(f".{_LATEST}-{os.getpid()}")
    fresh.symlink_to(path.name)
    fresh.replace(path.with_name(_LATEST))
