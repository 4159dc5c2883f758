"""``vli calibrate laser``: the laser plane from images of a board with the stripe on it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vli_calibration import laser_report
from vli_calibration.documents import check_target_file, merged, read_document, save_document
from vli_calibration.images import read_images
from vli_calibration.laser_calibration import LaserFit, LaserOptions, calibrate_laser
from vli_calibration.laser_model import camera_parameters
from vli_calibration.tables import text_table
from vli_calibration.targets import FORMS, parse_target
from vli_calibration.topics import add_topic_argument, topic
from vli_common.arrays import FloatArray
from vli_common.calibration import load_calibration
from vli_common.camera import CameraModel
from vli_common.errors import InputError

_HALF_WIDTH_SIGMAS = 2.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("source", type=Path, metavar="DIR|BAG", help="images of the board with the stripe on it, 10 or more")
    parser.add_argument("--target", required=True, metavar="T", help=FORMS.replace("%", "%%"))
    parser.add_argument("--calib", type=Path, required=True, metavar="C", help="calibration with cam0, of vli calibrate camera")
    parser.add_argument("--out", type=Path, required=True, metavar="C", help="calibration file to write; may be that of --calib")
    parser.add_argument(
        "--poses",
        type=Path,
        metavar="F",
        help="poses of an arm, T_base_tool; then images of the stripe alone, on the same table, count too",
    )
    parser.add_argument("--hold-camera", action="store_true", help="refine boards and plane only, not the camera")
    parser.add_argument(
        "--range", type=float, nargs=2, metavar=("NEAR", "FAR"), help="working range, metres; default: from the images"
    )
    add_topic_argument(parser, "image")
    parser.add_argument("--report", type=Path, metavar="DIR", help="write report.html and summary.json there")


def run(args: argparse.Namespace) -> int:
    """Find boards and stripes, fit the plane, write it, say what it is worth."""
    check_target_file(args.out, args.calib)
    target = parse_target(args.target)
    document = read_document(args.calib)
    camera = load_calibration(args.calib, None).camera
    images = read_images(args.source, args.poses, topic(args, "image"))
    options = LaserOptions(not args.hold_camera, known_sigmas(document, camera))
    fit = calibrate_laser(images, target, camera, options)
    if args.range is not None:
        fit = replace(fit, range_m=_range(args.range))
    save_document(args.out, _document(document, fit, _command(args)))
    if args.report is not None:
        laser_report.make_report(fit).write(args.report, laser_report.summary(fit) | {"target": target.spec})
    _tell(fit)
    return 0


def known_sigmas(document: Mapping[str, Any], camera: CameraModel) -> FloatArray:
    """Return how well each of the camera's parameters is known by its provenance: infinity without one, zero where held."""
    sigmas = _provenance_sigmas(document, len(camera_parameters(camera)))
    if document["cam0"].get("distortion_model") == "none":
        sigmas[4:] = 0.0
    return sigmas


def _provenance_sigmas(document: Mapping[str, Any], count: int) -> FloatArray:
    unknown = np.full(count, np.inf)
    provenance = document.get("cam0", {}).get("provenance")
    intervals = provenance.get("intervals") if isinstance(provenance, dict) else None
    if not isinstance(intervals, dict) or len(intervals) != count:
        return unknown
    try:
        ends = np.array(list(intervals.values()), np.float64)
        sigmas: FloatArray = (ends[:, 1] - ends[:, 0]) / (2 * _HALF_WIDTH_SIGMAS)
    except (ValueError, IndexError, TypeError):
        return unknown
    return sigmas if np.isfinite(sigmas).all() and (sigmas > 0).all() else unknown


def _range(values: list[float]) -> tuple[float, float]:
    near, far = values
    if not 0 < near < far:
        raise InputError(f"--range is '{near:g} {far:g}', expected 0 < NEAR < FAR, metres, such as --range 0.02 0.15")
    return near, far


def _document(document: dict[str, Any], fit: LaserFit, command: str) -> dict[str, Any]:
    where = laser_report.provenance(fit, command)
    if fit.camera_refined:
        refined = {"command": command, "note": "refined together with the laser plane"}
        lens = [] if document["cam0"].get("distortion_model") == "none" else list(fit.camera.coefficients)
        values = {"intrinsics": camera_parameters(fit.camera)[:4].tolist(), "distortion_coeffs": lens}
        document = merged(document, "cam0", values, refined, part="laser")
    return merged(document, "laser0", laser_report.section(fit), where)


def _command(args: argparse.Namespace) -> str:
    poses = f" --poses {args.poses}" if args.poses is not None else ""
    held = " --hold-camera" if args.hold_camera else ""
    return f"vli calibrate laser {args.source} --target {args.target} --calib {args.calib}{poses}{held}"


def _tell(fit: LaserFit) -> None:
    write = sys.stdout.write
    write(text_table(laser_report.IMAGE_HEADER, laser_report.image_rows(fit)) + "\n")
    for item in fit.rejected:
        write(f"{item.name}: rejected, {item.reason}\n")
    write("\n" + text_table(laser_report.KEY_HEADER, laser_report.key_rows(fit)) + "\n")
    level, sentence = laser_report.verdict(fit)
    sys.stdout.writelines(f"- {line}\n" for line in laser_report.remarks(fit) if line != sentence)
    write(f"{level.value}: {sentence}\n")
