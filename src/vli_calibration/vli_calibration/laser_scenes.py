"""What calibration images show: the board's pose, and the stripe on it."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from vli_calibration.board_pose import BoardPose, board_pose
from vli_calibration.board_surface import BoardSurface
from vli_calibration.boards import Target
from vli_calibration.detection import TargetDetector
from vli_calibration.progress import progress
from vli_calibration.stripe_on_board import BoardStripe, Scene, StripeFinder
from vli_calibration.types import CalibrationImage, Detection, Rejection
from vli_common.arrays import FloatArray
from vli_common.camera import CameraModel
from vli_common.errors import InputError

_MOST_WORKERS = 4
_MOST_RMS = 0.02
"""Reprojection error of a pose beyond this share of a square: another board, or another camera."""


@dataclass(frozen=True)
class LaserScene:
    """One image, and what was found in it.

    Args:
        image: as read.
        detection: of the board; None where it does not show.
        board: its pose with the camera as given; None where it has none.
        stripe: None where there is none.
        reason: why there is no board, in words; empty where there is one.
    """

    image: CalibrationImage
    detection: Detection | None
    board: BoardPose | None
    stripe: BoardStripe | None
    reason: str = ""

    @property
    def name(self) -> str:
        """Of the image."""
        return self.image.name

    @property
    def has_both(self) -> bool:
        """True where board and stripe show."""
        return self.board is not None and self.stripe is not None


def look_at(images: Sequence[CalibrationImage], target: Target, camera: CameraModel) -> tuple[list[LaserScene], StripeFinder]:
    """Find board and stripe in all images, and the direction and colour of the stripe.

    Raises:
        InputError: images of another size than the camera's.
    """
    _check_sizes(images, camera)
    found = TargetDetector(target).detect_all([image.pixels for image in images])
    boards: list[BoardPose | str] = [_board(target, camera, detection) for detection in found]
    scenes = [_scene(image, board, camera, target) for image, board in zip(images, boards, strict=True)]
    finder = StripeFinder.from_images(camera, scenes)
    with ThreadPoolExecutor(min(_MOST_WORKERS, len(os.sched_getaffinity(0)))) as pool:
        stripes = list(progress(pool.map(finder.find, scenes), len(scenes), "finding the stripe"))
    seen = [
        LaserScene(
            image,
            None if isinstance(detection, str) else detection,
            None if isinstance(board, str) else board,
            stripe,
            board if isinstance(board, str) else "",
        )
        for image, detection, board, stripe in zip(images, found, boards, stripes, strict=True)
    ]
    return seen, finder


def require_boards(scenes: Sequence[LaserScene], target: Target) -> None:
    """Raise where no image shows the board.

    Raises:
        InputError: with the commonest reason.
    """
    if not any(scene.board for scene in scenes):
        reason = Counter(scene.reason for scene in scenes).most_common(1)[0][0]
        raise InputError(
            f"no board '{target.spec}' found in {len(scenes)} of {len(scenes)} images ({reason}); check --target against the "
            "board, and  that the whole board shows, sharp and not overexposed"
        )


def require_stripes(scenes: Sequence[LaserScene], least: int) -> None:
    """Raise where too few images show a board with a stripe on it.

    Raises:
        InputError: saying in how many there is a stripe, and what to do.
    """
    striped, both = sum(scene.stripe is not None for scene in scenes), sum(scene.has_both for scene in scenes)
    if not striped:
        raise InputError(
            f"no laser stripe found in {len(scenes)} of {len(scenes)} images; switch the laser on, and let the stripe run over "
            "the board in 10 or more views"
        )
    if both < least:
        raise InputError(
            f"board and stripe together show in '{both}' of {len(scenes)} images, expected {least} or more; let the stripe run "
            "over the board in 10 or more views, tilted in several ways and at several distances"
        )


def rejections(scenes: Sequence[LaserScene]) -> list[Rejection]:
    """Return the images that show neither board nor stripe, or whose board was lost, with reasons."""
    return [Rejection(scene.name, scene.reason) for scene in scenes if scene.board is None and scene.stripe is None]


def corners(scene: LaserScene, target: Target) -> tuple[FloatArray, FloatArray]:
    """Return the kept corners of a scene: in the board frame (K, 3), and raw pixels (K, 2); none where there is no board."""
    if scene.board is None or scene.detection is None:
        return np.empty((0, 3)), np.empty((0, 2))
    kept = scene.board.kept
    return target.points[scene.detection.ids[kept]], scene.detection.pixels[kept]


def _scene(image: CalibrationImage, board: BoardPose | str, camera: CameraModel, target: Target) -> Scene:
    surface = None if isinstance(board, str) else BoardSurface(camera, board.T_cam_board, target)
    return Scene(image.pixels if image.stripe_pixels is None else image.stripe_pixels, surface)


def _board(target: Target, camera: CameraModel, detection: Detection | str) -> BoardPose | str:
    if isinstance(detection, str):
        return detection
    board = board_pose(camera, target.points[detection.ids], detection.pixels)
    if board is None:
        return "corners found, but no pose of the board fits them with this camera"
    square_px = BoardSurface(camera, board.T_cam_board, target).square_px
    if not board.rms_px <= max(_MOST_RMS * square_px, 1.5):
        return f"board fits its corners only to {board.rms_px:.1f} px with this camera; is --calib of this camera?"
    return board


def _check_sizes(images: Sequence[CalibrationImage], camera: CameraModel) -> None:
    for image in images:
        for pixels in (image.pixels, image.stripe_pixels):
            if pixels is not None and pixels.shape[1::-1] != (camera.width, camera.height):
                raise InputError(
                    f"image '{image.name}' is '{pixels.shape[1]} x {pixels.shape[0]}', the calibration is for {camera.width} x "
                    f"{camera.height}; use the calibration of this camera and resolution"
                )
