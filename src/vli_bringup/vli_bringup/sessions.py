"""The sessions of one run: a jump of the clock ends one, and what it left is kept in a directory of its own.

Poses of two sessions share no frame, so that neither trajectories nor maps of two can stand in one file. The last session is the
run's own; the n-th before it is ``session-n``, with the same names, and ``vli merge`` joins the maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vli_bringup.pipeline import Event, Pipeline
from vli_bringup.recorder import Recorder
from vli_common.calibration import Calibration
from vli_common.types import PointCloud
from vli_mapping.map_file import SUFFIX, save_map
from vli_mapping.mapper import Mapper
from vli_mapping.snapshot import take
from vli_mapping.store import write_ply


class Sessions:
    """Records a run session by session.

    Args:
        directory: of the results.
        calibration: see :class:`Recorder`.
        pipeline: that the events come from.
    """

    def __init__(self, directory: Path, calibration: Calibration, pipeline: Pipeline) -> None:
        self._directory, self._calibration, self._pipeline = directory, calibration, pipeline
        self._session = pipeline.session
        self._keyframes = self._poses = 0
        self.recorder = Recorder(calibration)
        """Of the present session; its states are those of all."""
        self.kept: list[str] = []
        """Names of the directories of earlier sessions in which something was tracked."""

    @property
    def keyframes(self) -> int:
        """Number of keyframes in all sessions."""
        return self._keyframes + self.recorder.keyframes

    @property
    def poses(self) -> int:
        """Number of live poses in all sessions."""
        return self._poses + len(self.recorder.live)

    def add(self, events: Sequence[Event]) -> None:
        """Take what a push of the pipeline brought; the push that began a session has brought the last of the one before."""
        self.recorder.add(events)
        if self._pipeline.session != self._session:
            self._end_session()

    def _end_session(self) -> None:
        """Write what the session left; the mapper lets go of its map only when the next one has a window."""
        before = self.recorder
        if before.live:
            name = f"session-{self._session + 1}"
            (self._directory / name).mkdir()
            before.write(self._directory / name)
            write_map(self._directory / name, self._pipeline.stages.mapper)
            self.kept.append(name)
        self._keyframes, self._poses = self.keyframes, self.poses
        self._session = self._pipeline.session
        self.recorder = Recorder(self._calibration)
        self.recorder.states, self.recorder.reason = before.states, before.reason


def write_map(directory: Path, mapper: Mapper) -> PointCloud:
    """Write the map of a scan that is at its end as a cloud, and whole; return the cloud."""
    mapper.develop()
    cloud = mapper.cloud()
    write_ply(directory / "map.ply", cloud)
    save_map(directory / f"map{SUFFIX}", take(mapper.map, mapper.light()))
    return cloud
