"""``vli calibrate camera``: intrinsics and distortion from images of a flat target."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from vli_calibration import camera_report
from vli_calibration.camera_calibration import calibrate_camera
from vli_calibration.camera_quality import remarks, verdict
from vli_calibration.camera_selection import MODEL_CHOICES
from vli_calibration.documents import check_target_file, write_document
from vli_calibration.images import read_images
from vli_calibration.tables import text_table
from vli_calibration.targets import FORMS, parse_target
from vli_calibration.topics import add_topic_argument, topic


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("source", type=Path, metavar="DIR|BAG", help="images of the target, 20 or more")
    parser.add_argument("--target", required=True, metavar="T", help=FORMS.replace("%", "%%"))
    parser.add_argument("--out", type=Path, required=True, metavar="C", help="calibration file; its other sections are kept")
    parser.add_argument("--model", choices=tuple(MODEL_CHOICES), default="auto", help="lens model (default: %(default)s)")
    add_topic_argument(parser, "image")
    parser.add_argument("--report", type=Path, metavar="DIR", help="write report.html and summary.json there")


def run(args: argparse.Namespace) -> int:
    """Find the target, fit the camera, write it, say what it is worth."""
    check_target_file(args.out)
    target = parse_target(args.target)
    images = read_images(args.source, image_topic=topic(args, "image"))
    found = calibrate_camera(images, target, args.model, args.report or args.out.parent, str(args.source))
    command = f"vli calibrate camera {args.source} --target {args.target} --model {args.model}"
    write_document(args.out, "cam0", camera_report.section(found.fit), camera_report.provenance(found, command))
    if args.report is not None:
        report = camera_report.make_report(found, {image.name: image.pixels for image in images})
        report.write(args.report, camera_report.summary(found))
    _tell(found)
    return 0


def _tell(found: camera_report.CameraCalibration) -> None:
    write = sys.stdout.write
    write(text_table(camera_report.VIEW_HEADER, camera_report.view_rows(found)) + "\n")
    for item in found.rejected:
        write(f"{item.name}: rejected, {item.reason}\n")
    write("\n" + text_table(camera_report.PARAMETER_HEADER, camera_report.parameter_rows(found.fit)) + "\n")
    write("\n" + text_table(("figure", "value"), camera_report.key_rows(found)) + "\n")
    write(f"- {found.selection.sentence}\n")
    write(f"- lengths rest on the stated size of the target, {found.target.spec}: measure the print with a ruler\n")
    level, sentence = verdict(found.fit, found.seen)
    sys.stdout.writelines(f"- {line}\n" for line in remarks(found.fit, found.seen) if line != sentence)
    write(f"{level.value}: {sentence}\n")
