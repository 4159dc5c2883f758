"""``vli calibrate imu``: noise densities and random walks of an IMU from a recording at rest."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from vli_calibration import imu_report
from vli_calibration.allan import measure_imu_noise
from vli_calibration.documents import check_target_file, write_document
from vli_calibration.imu_recording import read_imu_recording
from vli_calibration.tables import text_table
from vli_calibration.topics import add_topic_argument, topic


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("source", type=Path, metavar="BAG", help="the IMU at rest, hours of it; images are ignored")
    parser.add_argument("--out", type=Path, required=True, metavar="C", help="calibration file; its other sections are kept")
    parser.add_argument("--calib", type=Path, metavar="C", help="take the other sections from this file")
    add_topic_argument(parser, "imu")
    parser.add_argument("--report", type=Path, metavar="DIR", help="write report.html and summary.json there")


def run(args: argparse.Namespace) -> int:
    """Measure, write, say what it is worth."""
    check_target_file(args.out, args.calib)
    recording = read_imu_recording(args.source, topic(args, "imu"))
    noise = measure_imu_noise(recording)
    sentences = imu_report.remarks(noise, recording)
    command = f"vli calibrate imu {args.source}"
    write_document(args.out, "imu0", noise.section(), imu_report.provenance(noise, command), args.calib)
    if args.report is not None:
        report = imu_report.make_report(noise, recording)
        report.write(args.report, imu_report.summary(noise, recording, sentences))
    level, sentence = imu_report.verdict(noise)
    sys.stdout.write(text_table(imu_report.HEADER, imu_report.rows(noise)) + "\n")
    sys.stdout.writelines(f"- {line}\n" for line in sentences)
    sys.stdout.write(f"{level.value}: {sentence.removeprefix(f'{level.value}: ')}\n")
    return 0
