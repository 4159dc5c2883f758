"""``vli calibrate imu-camera``: rotation, translation and time offset between camera and IMU from a bag with a board."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from vli_calibration import imu_camera_report
from vli_calibration.board_bag import BoardFrames, find_board
from vli_calibration.board_track import track_board
from vli_calibration.boards import Target
from vli_calibration.documents import check_target_file, write_document
from vli_calibration.imu_camera import LEAST_FRAMES, ImuCameraFit, fit_imu_camera
from vli_calibration.imu_recording import read_imu_recording
from vli_calibration.tables import text_table
from vli_calibration.targets import FORMS, parse_target
from vli_calibration.topics import add_topic_argument, topic
from vli_common.arrays import FloatArray
from vli_common.calibration import load_calibration
from vli_common.errors import CalibrationError, InputError
from vli_common.geometry import pose


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("source", type=Path, metavar="BAG", help="camera and IMU, moved in front of the target for 30 s or more")
    parser.add_argument("--target", required=True, metavar="T", help=FORMS.replace("%", "%%"))
    parser.add_argument("--calib", type=Path, required=True, metavar="C", help="calibration with cam0 and imu0")
    parser.add_argument("--imu-calib", type=Path, metavar="F", help="Kalibr's imu.yaml, in place of imu0")
    parser.add_argument("--out", type=Path, required=True, metavar="C", help="calibration file to write, all else as in --calib")
    add_topic_argument(parser, "image", "imu")
    parser.add_argument("--report", type=Path, metavar="DIR", help="write report.html and summary.json there")


def run(args: argparse.Namespace) -> int:
    """Find the board, fit, write, say what it is worth."""
    check_target_file(args.out, args.calib)
    target = parse_target(args.target)
    calibration = load_calibration(args.calib, None, args.imu_calib)
    if calibration.imu is None:
        raise CalibrationError(
            str(args.calib),
            ["section 'imu0' is missing, the IMU's noise decides how far to trust it; make it with 'vli calibrate imu', or pass "
             "Kalibr's file with '--imu-calib'"],
        )  # fmt: skip
    recording = read_imu_recording(args.source, topic(args, "imu"))
    seen = find_board(args.source, target, calibration.camera, topic(args, "image"))
    _check_seen(seen, target)
    track = track_board(seen.stamps_ns, seen.detections, calibration.camera, target.points, _half_turn(target))
    fit = fit_imu_camera(track, recording, calibration.imu)
    errors = fit.track.residuals_px(calibration.camera, target.points, fit.board_poses)
    _write(args, fit, seen, errors)
    return 0


def _write(args: argparse.Namespace, fit: ImuCameraFit, seen: BoardFrames, errors: list[FloatArray]) -> None:
    say, rms_px = imu_camera_report, imu_camera_report.rms(errors)
    sentences = say.remarks(fit, seen.total)
    command = f"vli calibrate imu-camera {args.source} --target {args.target} --calib {args.calib}"
    record = say.provenance(fit, command, seen.total, rms_px)
    write_document(args.out, "cam0", say.section(fit), record, args.calib, part="imu_camera")
    if args.report is not None:
        report = say.make_report(fit, seen.total, errors, sentences)
        report.write(args.report, say.summary(fit, seen.total, rms_px, sentences))
    level, sentence = say.verdict(fit)
    sys.stdout.write(text_table(say.HEADER, say.rows(fit)) + "\n\n")
    sys.stdout.write(text_table(("figure", "value"), say.key_rows(fit, seen.total, rms_px)) + "\n")
    sys.stdout.writelines(f"- {line}\n" for line in sentences)
    sys.stdout.write(f"{level.value}: {sentence}\n")


def _check_seen(seen: BoardFrames, target: Target) -> None:
    if len(seen.detections) < LEAST_FRAMES:
        reason, count = seen.failures.most_common(1)[0] if seen.failures else ("the bag is short", seen.total)
        raise InputError(
            f"'{target.spec}' was found in '{len(seen.detections)}' of {seen.total} long frames, expected at least "
            f"{LEAST_FRAMES} (in {count}: {reason}); keep the board in view and lit, and check --target"
        )


def _half_turn(target: Target) -> FloatArray | None:
    """Return T_board_turned of a board that looks the same turned by 180°."""
    return pose(np.diag([-1.0, -1.0, 1.0]), target.points[0] + target.points[-1]) if target.symmetric else None
