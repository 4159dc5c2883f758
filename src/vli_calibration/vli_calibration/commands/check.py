"""``vli calibrate check``: how far to trust a calibration, from the stripe on a flat board."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from vli_calibration import check_report
from vli_calibration.images import read_images
from vli_calibration.laser_check import check_laser
from vli_calibration.laser_model import LaserPlane
from vli_calibration.laser_report import distance_rows
from vli_calibration.tables import text_table
from vli_calibration.targets import FORMS, parse_target
from vli_calibration.topics import add_topic_argument, topic
from vli_common.calibration import load_calibration
from vli_common.errors import CalibrationError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "source", type=Path, metavar="DIR|BAG", help="images of the board with the stripe on it, not those calibrated with"
    )
    parser.add_argument("--target", required=True, metavar="T", help=FORMS.replace("%", "%%"))
    parser.add_argument("--calib", type=Path, required=True, metavar="C", help="calibration with cam0 and laser0")
    add_topic_argument(parser, "image")
    parser.add_argument("--report", type=Path, metavar="DIR", help="write report.html and summary.json there")


def run(args: argparse.Namespace) -> int:
    """Triangulate the stripes, compare with the board, say what that means."""
    target = parse_target(args.target)
    calibration = load_calibration(args.calib, None)
    if calibration.laser is None:
        raise CalibrationError(str(args.calib), ["section 'laser0' is missing; make it with 'vli calibrate laser'"])
    plane = LaserPlane(calibration.laser.normal, calibration.laser.d)
    check = check_laser(read_images(args.source, image_topic=topic(args, "image")), target, calibration.camera, plane)
    if args.report is not None:
        check_report.make_report(check).write(args.report, check_report.summary(check))
    write = sys.stdout.write
    write(text_table(check_report.IMAGE_HEADER, check_report.image_rows(check)) + "\n\n")
    write(text_table(check_report.DISTANCE_HEADER, distance_rows(check.depths, check.errors)) + "\n")
    write(f"flatness {1e3 * check.flatness_rms_m:.3f} mm RMS, depth error {1e3 * check.error_rms_m:.3f} mm RMS\n")
    level, sentence = check_report.verdict(check)
    write(f"{level.value}: {sentence}\n")
    return 0
