"""The results directory: complete or not there at all."""

from __future__ import annotations

import os
import sys
from datetime import datetime
from pathlib import Path
from types import TracebackType

from vli_common.directories import NewDirectory
from vli_common.errors import OutputError
from vli_mapping.map_file import SUFFIX

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


class ScanDirectory(ResultsDirectory):
    """The results of a scan that nobody can make again: what there is of one that was cut off stays in ``DIR.partial``."""

    def rest(self) -> str:
        """Tell of maps and trajectories of a scan that was cut off."""
        left = self._left()
        return f"what is left of a scan that was cut off ({left})" if left else ""

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Move what was written into place; where something failed, leave what there is of the scan, and say so."""
        left = self._left() if kind is not None else ""
        if not left:
            super().__exit__(kind, error, trace)
        elif isinstance(error, OSError):
            raise OutputError(
                f"results cannot be written to '{self.partial}' ({error.strerror or error}); what there is stays there: {left}"
            ) from error
        else:
            sys.stderr.write(f"vli: what there is of the scan stays in '{self.partial}': {left}\n")

    def _left(self) -> str:
        """Return the names of maps and trajectories in ``DIR.partial``."""
        found = [*self.partial.rglob(f"*{SUFFIX}"), *self.partial.rglob("*.tum")]
        return ", ".join(sorted(str(path.relative_to(self.partial)) for path in found if path.stat().st_size))


def _link(path: Path) -> None:
    """Point ``results/latest`` at ``path``, without a moment in which it is missing."""
    fresh = path.with_name(f".{_LATEST}-{os.getpid()}")
    fresh.symlink_to(path.name)
    fresh.replace(path.with_name(_LATEST))
