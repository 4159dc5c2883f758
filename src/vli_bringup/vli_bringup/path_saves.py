"""The path on the disk while a graph still scans: what is left of it where the command itself is killed."""

from __future__ import annotations

import os
import sys
import time
from itertools import islice
from pathlib import Path

from vli_bringup.graph import AUTOSAVE
from vli_bringup.graph_sessions import GraphSessions
from vli_bringup.recorder import tum_text


class PathSaves:
    """Appends live poses to a TUM file beside the automatic saves of the map, named as they are: one for each session.

    Appending costs what is new, however long the scan is. The trajectories of the results take the place of these files.

    Args:
        sessions: of the graph, with their poses.
        directory: of the files.
        period_s: between two saves; 0: never.
    """

    def __init__(self, sessions: GraphSessions, directory: Path, period_s: float) -> None:
        self._sessions, self._period_s = sessions, period_s
        self._path = (directory / AUTOSAVE).with_suffix(".tum")
        self._saved_s = time.monotonic()
        self._recorder, self._number, self._count = sessions.recorder, sessions.number, 0

    def look(self) -> None:
        """Save where it is time; a disk that takes no more is told of, once, and does not end the scan."""
        if not self._period_s or time.monotonic() < self._saved_s + self._period_s:
            return
        self._saved_s = time.monotonic()
        try:
            self.save()
        except OSError as error:
            sys.stderr.write(f"vli: automatic save: '{self._path}' cannot be written: {error.strerror or error}\n")
            self._period_s = 0.0

    def save(self) -> None:
        """Append the poses since the last save; those of a session that has ended stay in a file of their own.

        Raises:
            OSError: the disk does not take them.
        """
        self._append()
        if self._sessions.recorder is not self._recorder:
            if self._count:
                self._path.replace(self._path.with_stem(f"{self._path.stem}_session-{self._number}"))
            self._recorder, self._number, self._count = self._sessions.recorder, self._sessions.number, 0
            self._append()

    def remove(self) -> None:
        """Remove the files: the results are written."""
        for path in self._path.parent.glob(f"{self._path.stem}*{self._path.suffix}"):
            path.unlink()

    def _append(self) -> None:
        poses = self._recorder.live
        if len(poses) > self._count:
            with self._path.open("a") as stream:
                stream.write(tum_text(dict(islice(poses.items(), self._count, None))))
                stream.flush()
                os.fsync(stream.fileno())
            self._count = len(poses)
