"""``vli doctor``: is this recording, or this sensor, fit for a scan? Says what to change, one line each."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from vli_bringup.arguments import add_source_arguments, bag_topics, source_settings
from vli_bringup.diagnosis.calibration import check_calibration
from vli_bringup.diagnosis.camera import CameraCheck
from vli_bringup.diagnosis.findings import Check, Finding, Level, to_text, worst
from vli_bringup.diagnosis.imu import ImuCheck
from vli_bringup.input_checks import check_part
from vli_bringup.settings import Settings
from vli_common.calibration import Calibration, load_calibration
from vli_common.errors import InputError
from vli_common.types import EncodedImage, ImuSample, Mode
from vli_driver.bag import BagReader

UNFIT = 1
_SPAN_S = 20.0
_LIVE_S = 5.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``vli doctor``."""
    parser.add_argument("bag", metavar="BAG", type=Path, nargs="?", help="rosbag2 directory or bare .mcap")
    parser.add_argument("--live", action="store_true", help="listen to the sensor and to the nodes that run, in place of a bag")
    parser.add_argument("--calib", metavar="C", type=Path, help="calibration file; without it, the stripe is not looked at")
    add_source_arguments(parser)
    parser.set_defaults(duration=None)


def run(args: argparse.Namespace) -> int:
    """Diagnose; return 0, or 1 where a scan will not work.

    Raises:
        VliError: there is nothing to look at: no bag, no topic, a broken calibration.
    """
    if (args.bag is None) == (not args.live):
        raise InputError("expected either a BAG or --live; see 'vli doctor --help'")
    if args.live and args.start:
        raise InputError(f"--start is '{args.start:g}', which is of a bag; with --live give --duration alone")
    settings = source_settings(args)
    calibration = load_calibration(args.calib, None, args.imu_calib) if args.calib else None
    findings = list(check_calibration(args.calib, args.imu_calib, calibration)) if calibration else []
    findings += _listen(settings, calibration, args) if args.live else _read(settings, calibration, args)
    print(to_text(findings))
    verdict = worst(findings)
    print(f"\n{_VERDICTS[verdict]}")
    return UNFIT if verdict is Level.PROBLEM else 0


_VERDICTS = {
    Level.GOOD: "fit for a scan",
    Level.WARNING: "fit for a scan, with the warnings above",
    Level.PROBLEM: "not fit for a scan: see the problems above",
}


def diagnose(items: Iterable[EncodedImage | ImuSample], checks: list[Check]) -> Iterator[Finding]:
    """Show every item to every check, then yield what they found."""
    for item in items:
        for check in checks:
            check.add(item)
    for check in checks:
        yield from check.findings()


def _read(settings: Settings, calibration: Calibration | None, args: argparse.Namespace) -> list[Finding]:
    """Diagnose the first 20 s of a bag, or what is asked for."""
    topics = replace(bag_topics(settings, Mode.VLI_SLAM), imu_required=False)
    reader = BagReader(args.bag, topics, args.start, _SPAN_S if args.duration is None else args.duration)
    check_part(reader)
    checks: list[Check] = [CameraCheck(calibration, settings)]
    findings = []
    if reader.imu_topic:
        checks.append(ImuCheck(calibration, reader.imu_topic))
    else:
        findings.append(Finding(Level.WARNING, "IMU", "the bag has none; only --mode vl works"))
    findings += list(diagnose(reader, checks))
    return findings + [Finding(Level.WARNING, "bag", warning) for warning in reader.warnings]


def _listen(settings: Settings, calibration: Calibration | None, args: argparse.Namespace) -> list[Finding]:
    """Diagnose what comes over the topics for a few seconds, and what the nodes say of themselves."""
    from vli_bringup.diagnosis.live import listen

    seconds = _LIVE_S if args.duration is None else args.duration
    sys.stderr.write(f"vli doctor: listening for {seconds:g} s\n")
    heard = listen(settings.driver, seconds)
    checks: list[Check] = []
    if heard.has_camera:
        checks.append(CameraCheck(calibration, settings))
    if heard.has_imu:
        checks.append(ImuCheck(calibration, settings.driver.imu_topic))
    return [*heard.findings, *diagnose(heard.items, checks)]
