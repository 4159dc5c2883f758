"""Where a recording goes: ``DIR.partial`` while it lasts, ``DIR`` when it has ended."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

from vli_common.directories import NewDirectory
from vli_common.errors import VliError


class RecordingDirectory(NewDirectory):
    """Context manager: a crash leaves ``DIR.partial``, which is read as it is and never replaced unasked.

    Args:
        out: its name in the end.
        overwrite: True lets a recording of that name be replaced, the rest of one that was cut off too.

    Raises:
        OutputError: there is something already, or the directory cannot be made.
    """

    def __init__(self, out: Path, overwrite: bool) -> None:
        super().__init__(out, f"{out.name}_0.mcap", overwrite)

    def rest(self) -> str:
        """Tell of a recording that was cut off."""
        is_there = (self.partial / self._marker).exists()
        return "a recording that was cut off, which every command reads as it is" if is_there else ""

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Give the recording its name; one that is known to hold nothing is removed, one that something broke stays as it is."""
        if kind is None or issubclass(kind, VliError):
            super().__exit__(kind, error, trace)
