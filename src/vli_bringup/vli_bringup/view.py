"""``vli view``: results, a map, a bag or a running scan, in a browser."""

from __future__ import annotations

import argparse
import sys
import threading
from pathlib import Path

from vli_bringup.arguments import add_topic_argument, bag_topics, chosen_topics, duration
from vli_bringup.output import SUMMARY
from vli_bringup.settings import Settings
from vli_bringup.stopping import stop_on_signals
from vli_bringup.viewing.bag import BagDisplay, read_recording
from vli_bringup.viewing.results import show_results
from vli_bringup.viewing.scene import Scene
from vli_common.calibration import load_calibration
from vli_common.errors import InputError
from vli_common.types import Mode
from vli_driver.bag import BagReader
from vli_driver.scanner import StripeScanner
from vli_mapping.map_file import SUFFIX

_PORT = 8080
_SPAN_S = 20.0
_POLL_S = 0.2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``vli view``."""
    parser.add_argument("what", metavar="DIR|BAG", type=Path, nargs="?", help="results, a map (.vli .ply), or a bag")
    parser.add_argument("--live", action="store_true", help="what the running nodes publish")
    parser.add_argument("--port", metavar="N", type=_port, default=_PORT, help="of this machine (default: %(default)s)")
    parser.add_argument("--no-browser", action="store_true", help="say where it is, and open nothing")
    parser.add_argument("--calib", metavar="C", type=Path, help="with a bag: calibration, for the stripe")
    parser.add_argument("--start", metavar="S", type=float, default=0.0, help="with a bag: skip the first S seconds")
    parser.add_argument(
        "--duration", metavar="D", type=duration, default=_SPAN_S, help="with a bag: seconds to show (default: %(default)s)"
    )
    add_topic_argument(parser)


def run(args: argparse.Namespace) -> int:
    """Show until SIGINT or SIGTERM; return 0.

    Raises:
        VliError: there is nothing to show, or viser is not installed.
    """
    if (args.what is None) == (not args.live):
        raise InputError("expected either a DIR, a BAG or --live; see 'vli view --help'")
    with stop_on_signals() as stop, Scene("vli live" if args.live else f"vli {args.what.name}", args.port) as scene:
        if args.live:
            _announce(scene, args)
            _follow(scene, stop)
            return 0
        if is_result(args.what):
            show_results(scene, args.what)
        else:
            show_bag(scene, args)
        _announce(scene, args)
        while not stop.wait(_POLL_S):
            pass
    return 0


def is_result(path: Path) -> bool:
    """Return True for results and maps, False for what may be a bag."""
    if path.is_dir():
        return any((path / name).is_file() for name in (SUMMARY, f"map{SUFFIX}", "map.ply"))
    return path.suffix.lower() in (SUFFIX, ".ply")


def show_bag(scene: Scene, args: argparse.Namespace) -> BagDisplay:
    """Show the part of a bag that is asked for.

    Raises:
        InputError: there is no image in it.
    """
    settings = Settings(driver=chosen_topics(args))
    calibration = load_calibration(args.calib, None) if args.calib else None
    reader = BagReader(args.what, bag_topics(settings, Mode.VL), args.start, args.duration)
    recording = read_recording(reader, settings)
    for warning in reader.warnings:
        sys.stderr.write(f"vli view: warning: {warning}\n")
    laser = calibration is not None and calibration.laser is not None
    scanner = StripeScanner(calibration, settings.stripe) if calibration is not None and laser else None
    return BagDisplay(scene, recording, scanner, calibration)


def _follow(scene: Scene, stop: threading.Event) -> None:
    # Only this needs ROS.
    from vli_bringup.viewing.live import LiveDisplay
    from vli_bringup.viewing.live_listener import LiveListener

    with LiveListener(LiveDisplay(scene)) as listener:
        while not stop.is_set():
            listener.spin(_POLL_S)


def _announce(scene: Scene, args: argparse.Namespace) -> None:
    print(f"{scene.url} (Ctrl-C ends it; from elsewhere: ssh -L {args.port}:{scene.url.removeprefix('http://')} this-machine)")
    sys.stdout.flush()
    if not args.no_browser:
        scene.open_browser()


def _port(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 65535:
        raise argparse.ArgumentTypeError(f"'{text}', expected 1 to 65535")
    return int(text)
