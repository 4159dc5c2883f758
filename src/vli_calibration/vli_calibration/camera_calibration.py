"""From images to a camera: detection, fit, choice of the lens model, and an error that helps where there is nothing to fit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cv2

from vli_calibration.camera_fit import LEAST_VIEWS, View
from vli_calibration.camera_report import CameraCalibration, brightened
from vli_calibration.camera_selection import select_camera
from vli_calibration.coverage import coverage
from vli_calibration.detection import TargetDetector
from vli_calibration.detection_chessboard import seen_size
from vli_calibration.documents import write_atomically
from vli_calibration.subpixel import board_grey
from vli_calibration.targets import Chessboard, Target
from vli_calibration.types import CalibrationImage, Rejection
from vli_common.arrays import ByteArray
from vli_common.errors import InputError

_EXAMPLE = "no_board_{}.png"
_PROBED = 8


def calibrate_camera(
    images: Sequence[CalibrationImage], target: Target, model: str, example_directory: Path, source: str
) -> CameraCalibration:
    """Return the camera that took the images.

    Args:
        images: all of one size.
        target: what to look for in them.
        model: key of :data:`vli_calibration.camera_selection.MODEL_CHOICES`.
        example_directory: where a picture is written if too few images show the target.
        source: what the images came from, for messages.

    Raises:
        InputError: too few boards, or views that do not determine a camera.
    """
    results = TargetDetector(target).detect_all([image.pixels for image in images])
    views = [View(image.name, found) for image, found in zip(images, results, strict=True) if not isinstance(found, str)]
    missing = [Rejection(image.name, why) for image, why in zip(images, results, strict=True) if isinstance(why, str)]
    if len(views) < LEAST_VIEWS:
        raise InputError(_too_few(images, missing, target, example_directory, source))
    height, width = images[0].pixels.shape[:2]
    selection = select_camera(views, target, (width, height), model)
    return CameraCalibration(
        selection,
        target,
        coverage(selection.fit.views, target.points, (width, height)),
        (*missing, *selection.fit.rejected),
        len(images),
        sum(len(view.detection) for view in views),
    )


def _too_few(
    images: Sequence[CalibrationImage], missing: Sequence[Rejection], target: Target, directory: Path, source: str
) -> str:
    """Return the line that says in how many images there is no board, why, and what else was seen; write one as an example."""
    found = len(images) - len(missing)
    if not missing:
        return f"'{source}' holds '{found}' images, expected {LEAST_VIEWS} or more, better 20, at different tilts and distances"
    reasons = Counter(item.reason.split(":")[0] for item in missing).most_common(3)
    why = ", ".join(f"{count} × {reason}" for reason, count in reasons)
    pixels = {image.name: image.pixels for image in images}
    example = _write_example(directory, missing, pixels)
    hint = _other_board([pixels[item.name] for item in missing], target) or "check --target, light and focus"
    return (
        f"the board '{target.spec}' is found in '{found}' of {len(images)} images of '{source}', expected {LEAST_VIEWS} or more "
        f"({why}; an example is '{example}'); {hint}"
    )


def _write_example(directory: Path, missing: Sequence[Rejection], pixels: dict[str, ByteArray]) -> Path:
    """Write the brightest of the images without a board: where it should be seen, if anywhere."""
    item = max(missing, key=lambda item: float(pixels[item.name].mean()))
    picture = brightened(pixels[item.name])
    path = directory / _EXAMPLE.format(Path(item.name).stem)
    done, data = cv2.imencode(".png", picture)
    if done:
        write_atomically(path, data.tobytes())
    return path


def _other_board(pixels: Sequence[ByteArray], target: Target) -> str:
    """Return what to type instead where most images show a chessboard of one other size."""
    if not isinstance(target, Chessboard):
        return ""
    step = max(1, len(pixels) // _PROBED)
    sizes = Counter(size for size in (seen_size(board_grey(image)) for image in pixels[::step]) if size is not None)
    wanted = max(target.columns, target.rows), min(target.columns, target.rows)
    if not sizes or sizes.most_common(1)[0][0] == wanted:
        return ""
    (columns, rows), _ = sizes.most_common(1)[0]
    return f"{columns}x{rows} inner corners are seen, so try --target chessboard:{columns}x{rows}:{target.square:g}"
