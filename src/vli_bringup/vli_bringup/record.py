"""``vli record``: what a scanner sends, to a bag."""

from __future__ import annotations

import argparse
import sys
import threading
import time
from pathlib import Path

from tqdm import tqdm

from vli_bringup.arguments import add_topic_argument, chosen_topics, duration
from vli_bringup.recording.bag_writer import BagWriter
from vli_bringup.recording.directory import RecordingDirectory
from vli_bringup.recording.listener import RecordingListener, graph_topics, scanner_topics
from vli_bringup.recording.topic import RecordedTopic
from vli_bringup.recording.transforms import TransformMaker, are_published
from vli_bringup.recording.writer_thread import WriterThread
from vli_bringup.stopping import stop_on_signals
from vli_common.errors import InputError, OutputError, VliError
from vli_driver.bag_file import McapFile

_SPIN_S = 0.05
_PATIENCE_S = 5.0
"""A camera or an IMU that nobody publishes is told after this long."""
_MEGABYTE = 1e6


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``vli record``."""
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="the bag: a rosbag2 directory (mcap)")
    parser.add_argument("--overwrite", action="store_true", help="replace the recording in DIR")
    parser.add_argument("--all", action="store_true", help="what the nodes publish too: poses, clouds, map, status …")
    parser.add_argument("--duration", metavar="D", type=duration, help="stop after D seconds (default: at Ctrl-C)")
    add_topic_argument(parser)


def run(args: argparse.Namespace) -> int:
    """Record until SIGINT, SIGTERM or the end of ``--duration``; return 0.

    Raises:
        VliError: there is no place for the recording, the disk is full, or nothing came.
    """
    topics = scanner_topics(chosen_topics(args)) + (graph_topics() if args.all else [])
    with RecordingDirectory(args.out, args.overwrite) as directory:
        writer = WriterThread(BagWriter(directory, args.out.name))
        maker = TransformMaker(writer.put) if args.all and not are_published() else None
        with stop_on_signals() as stop, RecordingListener(topics, maker.put if maker else writer.put) as listener:
            _record(listener, writer, stop, args.duration)
            recorded = listener.recorded + (maker.recorded if maker else [])
        failure = writer.close()
        count = _messages_in(directory)
        if not count:
            raise _nothing_recorded(recorded, failure)
    print(summary(recorded, args.out))
    if failure is not None:
        raise OutputError(
            f"the recording ended early ({failure.strerror}); {count} messages are in '{args.out}', which every command reads; "
            "choose another disk with --out DIR"
        )
    return 0


def summary(recorded: list[RecordedTopic], path: Path) -> str:
    """Return what was recorded, a line a topic, and where it lies."""
    lines = [f"{'topic':<34}{'messages':>10}{'Hz':>9}{'MB':>10}{'lost':>7}"]
    for topic in recorded:
        if topic.messages or topic.lost:
            size = f"{topic.size / _MEGABYTE:.1f}"
            lines.append(f"{topic.name:<34}{topic.messages:>10}{topic.rate_hz:>9.1f}{size:>10}{topic.lost:>7}")
    return "\n".join([*lines, f"recording in '{path}'; vli doctor {path} says whether it is fit for a scan"])


def _record(listener: RecordingListener, writer: WriterThread, stop: threading.Event, duration_s: float | None) -> None:
    """Take what comes until told to stop, or until the disk fails."""
    start_s, elapsed_s, is_silence_told = time.monotonic(), 0.0, False
    with tqdm(bar_format="{desc}", disable=not sys.stderr.isatty(), leave=False) as line:
        while not stop.is_set() and writer.error is None and (duration_s is None or elapsed_s < duration_s):
            elapsed_s = time.monotonic() - start_s
            if writer.is_behind:
                stop.wait(_SPIN_S)
                continue
            for text in listener.spin(_SPIN_S):
                line.write(f"vli record: {text}", file=sys.stderr)
            if elapsed_s > _PATIENCE_S and not is_silence_told and (missing := listener.missing()):
                names = " and ".join(f"'{name}'" for name in missing)
                line.write(f"vli record: nobody publishes {names} yet", file=sys.stderr)
                is_silence_told = True
            line.set_description_str(_progress(listener.recorded, elapsed_s))
        writer.take_the_rest()
        listener.close()


def _progress(recorded: list[RecordedTopic], elapsed_s: float) -> str:
    messages, size = sum(topic.messages for topic in recorded), sum(topic.size for topic in recorded)
    lost = sum(topic.lost for topic in recorded)
    return f"{elapsed_s:.0f} s, {messages} messages, {size / _MEGABYTE:.0f} MB, {lost} lost; Ctrl-C ends it"


def _messages_in(directory: Path) -> int:
    files = [McapFile(path) for path in directory.glob("*.mcap")]
    return sum(topic.count for file in files for topic in file.topics.values())


def _nothing_recorded(recorded: list[RecordedTopic], failure: OSError | None) -> VliError:
    if failure is not None:
        return OutputError(f"nothing could be recorded ({failure.strerror}); choose another disk with --out DIR")
    names = ", ".join(f"'{topic.name}'" for topic in recorded)
    return InputError(f"nothing was recorded: no message came on {names}; start the driver, or name its topics with --topic")
