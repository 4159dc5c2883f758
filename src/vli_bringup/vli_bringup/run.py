"""``vli run``: a bag to trajectories and a coloured map, offline and deterministic."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
from tqdm import tqdm

from vli_bringup.arguments import add_scan_arguments, bag_topics, source_settings
from vli_bringup.input_checks import check_input, check_part
from vli_bringup.output import CONFIG, SUMMARY, ResultsDirectory
from vli_bringup.pipeline import Pipeline, Stages
from vli_bringup.sessions import Sessions, write_map
from vli_bringup.settings import Settings, to_yaml
from vli_bringup.warm_up import warm_up
from vli_common.calibration import load_calibration
from vli_common.types import NANOSECONDS, EncodedImage, ImuSample, Mode
from vli_driver.bag import BagReader
from vli_mapping.render import write_views

NEVER_TRACKED = 1
_SWITCH_S = 2e-4
"""How soon a thread that needs the interpreter gets it; Python's default of 5 ms is a whole frame's time."""


@dataclass(frozen=True, slots=True)
class Clock:
    """Wall and processor time of a run, seconds.

    Args:
        startup_s: from the start of the command to the first message: imports, checks, compilation.
        wall_s: from then until the map was complete; files are written after that.
        cpu_s: of the process, over both.
        bag_s: of the data that were read, by their stamps.
    """

    startup_s: float
    wall_s: float
    cpu_s: float
    bag_s: float

    def summary(self) -> dict[str, float]:
        """Return the figures of ``summary.json``; the factor is bag seconds per wall second."""
        figures = {
            "startup_s": self.startup_s,
            "wall_s": self.wall_s,
            "cpu_s": self.cpu_s,
            "realtime_factor": self.bag_s / self.wall_s if self.wall_s > 0 else 0.0,
        }
        return {name: round(value, 3) for name, value in figures.items()}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``vli run``."""
    add_scan_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run a bag and write the results; return 0, or 1 where tracking never started.

    Raises:
        VliError: nothing usable: bag, calibration, parameters or output directory.
    """
    mode = Mode(args.mode)
    settings = source_settings(args)
    calibration = load_calibration(args.calib, mode, args.imu_calib)
    topics = bag_topics(settings, mode)
    warnings = check_input(BagReader(args.bag, topics), calibration, mode.uses_imu)
    reader = BagReader(args.bag, topics, args.start, args.duration)
    check_part(reader)
    results = ResultsDirectory(args.out, args.overwrite)
    with results as directory:
        _share_processor()
        warm_up()
        pipeline = Pipeline(Stages.create(calibration, settings, mode), mode)
        sessions = Sessions(directory, calibration, pipeline)
        clock = process(reader, pipeline, sessions, _duration_s(reader, args.start, args.duration), args.started_s)
        write(directory, pipeline, sessions, clock, settings)
    for warning in [*warnings, *reader.warnings, *_losses(pipeline), *_earlier(sessions, results.path)]:
        _note(f"warning: {warning}")
    return report(pipeline, sessions, results.path)


def _share_processor() -> None:
    """Leave one core each to the two threads of the pipeline: OpenCV's own would take it from them."""
    sys.setswitchinterval(_SWITCH_S)
    cv2.setNumThreads(1)


def process(reader: BagReader, pipeline: Pipeline, sessions: Sessions, duration_s: float, started_s: float) -> Clock:
    """Push everything the reader has through the pipeline and record what comes out.

    Args:
        reader: of the part of the bag that is asked for.
        pipeline: fresh.
        sessions: fresh.
        duration_s: seconds of bag to expect, for the progress bar.
        started_s: ``time.perf_counter()`` when the command started.
    """
    begin_s = time.perf_counter()
    bag_s = 0.0
    for item, elapsed_s in _with_progress(reader, duration_s):
        bag_s = elapsed_s
        sessions.add(pipeline.push(item))
    sessions.add(pipeline.flush())
    end_s = time.perf_counter()
    return Clock(begin_s - started_s, end_s - begin_s, time.process_time(), bag_s)


def write(directory: Path, pipeline: Pipeline, sessions: Sessions, clock: Clock, settings: Settings) -> None:
    """Write trajectories, map, picture, times, parameters and summary."""
    sessions.recorder.write(directory)
    cloud = write_map(directory, pipeline.stages.mapper)
    write_views(directory / "cloud.png", cloud)
    pipeline.timer.write(directory / "timing.csv")
    (directory / CONFIG).write_text(to_yaml(settings))
    summary = {
        "frames_long": pipeline.counters["long_images"],
        "frames_short": pipeline.counters["short_images"],
        "keyframes": sessions.keyframes,
        "points": len(cloud),
        "states": sessions.recorder.states,
        **clock.summary(),
        **pipeline.timer.summary(),
    }
    (directory / SUMMARY).write_text(json.dumps(summary, indent=1) + "\n")


def report(pipeline: Pipeline, sessions: Sessions, path: Path) -> int:
    """Say what came out; return the exit code."""
    long_frames = pipeline.counters["long_images"]
    if not sessions.poses:
        _note(f"tracking never started in {long_frames} long frames: {sessions.recorder.reason}")
        return NEVER_TRACKED
    figures = pipeline.timer.summary()
    print(
        f"{sessions.poses} poses of {long_frames} long frames, {len(pipeline.stages.mapper.map)} map points, "
        f"{figures['ms_per_frame_mean']} ms a frame; results in '{path}'"
    )
    return 0


def _with_progress(reader: BagReader, duration_s: float) -> Iterator[tuple[EncodedImage | ImuSample, float]]:
    """Yield what the reader has with the bag seconds gone; a bar shows them on a terminal, and nothing elsewhere."""
    with tqdm(total=round(duration_s, 1), unit="s", disable=not sys.stderr.isatty(), leave=False) as bar:
        first_ns: int | None = None
        for item in reader:
            first_ns = item.stamp_ns if first_ns is None else first_ns
            bag_s = (item.stamp_ns - first_ns) / NANOSECONDS
            bar.update(max(0.0, round(bag_s, 1) - bar.n))
            yield item, bag_s


def _duration_s(reader: BagReader, start_s: float, duration_s: float | None) -> float:
    """Return how much there is to read, as far as the bag's headers tell."""
    start_ns, end_ns = reader.time_range_ns
    left_s = max(0.0, (end_ns - start_ns) / NANOSECONDS - start_s)
    return left_s if duration_s is None else min(left_s, duration_s)


def _losses(pipeline: Pipeline) -> list[str]:
    """Return a line for each kind of data that had to be left out."""
    front_end = pipeline.stages.front_end.counters
    counts = {
        "undecodable images": pipeline.counters["undecodable_images"],
        "images of another shape": pipeline.counters["images_of_another_shape"],
        "IMU samples that are not finite": front_end["imu_not_finite"],
        "IMU samples that came too late": front_end["imu_too_late"],
    }
    return [f"{count} {what} were left out" for what, count in counts.items() if count]


def _earlier(sessions: Sessions, path: Path) -> list[str]:
    """Return a line that says where earlier sessions are, where there were any."""
    if not sessions.kept:
        return []
    found = ", ".join(f"'{path / name}'" for name in sessions.kept)
    return [f"the clock jumped, and what was scanned before is in {found}; join the maps with: vli merge"]


def _note(text: str) -> None:
    print(f"vli run: {text}", file=sys.stderr)
