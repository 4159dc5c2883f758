"""Images of the board, one by one: for the camera, for the laser, and from an arm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vli_common.arrays import ByteArray, Float32Array, FloatArray
from vli_common.errors import OutputError
from vli_common.geometry import inverse, pose, quaternion_from_rotation, so3_exp
from vli_simulation.board.render import Exposures
from vli_simulation.board.simulate import BoardSimulation
from vli_simulation.parallel import in_order, single_threaded_opencv
from vli_simulation.render import View

POSES_FILE = "data.txt"
_WHITE_GREY = 165.0
_LONGEST_S = 0.03
_SHAKE_M_S, _SHAKE_RAD_S = 2e-3, np.deg2rad(1.5)
_CAMERA_STREAM, _LASER_STREAM, _ARM_STREAM = 22, 23, 24
"""Each part draws from a stream of its own, so that it is the same whichever others are made."""


class Shot(Enum):
    """What an image shows."""

    LONG = "laser off"
    SHORT = "laser on, little else"
    COMBINED = "board and stripe"


@dataclass(frozen=True)
class Still:
    """One image to be made.

    Args:
        name: of the file.
        shot: what it shows.
        view: of the camera in the board's frame.
        T_cam_board: (4, 4).
        key: of its noise.
    """

    name: str
    shot: Shot
    view: View
    T_cam_board: FloatArray
    key: tuple[int, ...]


def camera_stills(simulation: BoardSimulation) -> list[Still]:
    """Return the images for the camera: long exposures, laser off."""
    poses = simulation.planner.camera_views(simulation.config.board.images, _rng(simulation, _CAMERA_STREAM))
    return _stills(simulation, poses, {Shot.LONG: ""}, _CAMERA_STREAM)


def laser_stills(simulation: BoardSimulation) -> list[Still]:
    """Return the images for the laser: pairs, or combined ones; from an arm, also of the stripe alone."""
    board, rng = simulation.config.board, _rng(simulation, _LASER_STREAM)
    poses = simulation.planner.laser_views(board.images, rng)
    if not (board.combined or board.arm):
        return _stills(simulation, poses, {Shot.LONG: "_long", Shot.SHORT: "_short"}, _LASER_STREAM)
    stills = _stills(simulation, poses, {Shot.COMBINED: ""}, _LASER_STREAM)
    if board.arm:
        alone = simulation.planner.stripe_views(board.images // 2, rng)
        stills += _stills(simulation, alone, {Shot.SHORT: ""}, _LASER_STREAM, len(poses))
    return stills


def write_stills(
    simulation: BoardSimulation, stills: list[Still], out: Path, workers: int | None, progress: Callable[[int], object]
) -> dict[str, Any]:
    """Write images into a new directory; return the truth about each: pose of the board and exposure."""
    out.mkdir(parents=True)
    truth: dict[str, Any] = {}
    with single_threaded_opencv():
        images = in_order(lambda index: _render(simulation, stills[index]), len(stills), workers)
        for still, (pixels, exposure_s) in zip(stills, images, strict=True):
            path = out / still.name
            if not cv2.imwrite(str(path), pixels):
                raise OutputError(f"cannot write the image '{path}'; is the disk full?")
            truth[f"{out.name}/{still.name}"] = {"T_cam_board": still.T_cam_board, "exposure_s": exposure_s}
            progress(1)
    return truth


def write_arm_poses(simulation: BoardSimulation, stills: list[Still], path: Path) -> dict[str, Any]:
    """Write T_base_tool of each image as arms log it, three lines an image; return the truth about arm and hand.

    The format is that of the Blaser's published sets: ``[x, y, z]``, ``[qx, qy, qz, qw]``, file name.
    """
    rng, board = _rng(simulation, _ARM_STREAM), simulation.config.board
    T_tool_cam = pose(so3_exp(np.array([0.1, -0.2, 0.7]) + rng.normal(0, 0.1, 3)), rng.normal([0.0, 0.03, 0.08], 0.02))
    T_base_board = pose(so3_exp(rng.normal(0, 0.03, 3)) @ np.diag([1.0, -1.0, -1.0]), np.array([0.1, 0.45, 0.12]))
    lines = []
    for still in stills:
        T_base_tool = T_base_board @ still.view.T_world_cam @ inverse(T_tool_cam)
        error = pose(so3_exp(rng.normal(0, board.arm_noise_rad, 3)), rng.normal(0, board.arm_noise_m, 3))
        logged = T_base_tool @ error
        quaternion = quaternion_from_rotation(logged[:3, :3])
        lines += [str(logged[:3, 3].tolist()), str(quaternion.tolist()), still.name]
    path.write_text("\n".join(lines) + "\n")
    return {"T_tool_cam": T_tool_cam, "T_base_board": T_base_board}


def _rng(simulation: BoardSimulation, *key: int) -> np.random.Generator:
    return np.random.default_rng([simulation.seed, *key])


def _stills(
    simulation: BoardSimulation, poses: list[FloatArray], shots: dict[Shot, str], stream: int, first: int = 0
) -> list[Still]:
    """Return the images of each pose; ``shots`` has what their names end with."""
    shake = 0.0 if simulation.config.board.arm else simulation.config.board.shake
    stills = []
    for index, T_cam_board in enumerate(poses, first):
        rng = _rng(simulation, stream, index)
        motion = shake * np.concatenate([rng.normal(0, _SHAKE_M_S, 3), rng.normal(0, _SHAKE_RAD_S, 3)])
        view = View(inverse(T_cam_board), motion[:3], motion[3:])
        for number, (shot, suffix) in enumerate(shots.items()):
            stills.append(Still(f"{index:03d}{suffix}.png", shot, view, T_cam_board, (stream, index, number)))
    return stills


def _render(simulation: BoardSimulation, still: Still) -> tuple[ByteArray, float]:
    """Return the image, (H, W, 3) or, of a monochrome sensor, (H, W), and its exposure in seconds."""
    rng = _rng(simulation, *still.key)
    exposures = simulation.exposures(still.view, _WHITE_GREY, _LONGEST_S)
    light, exposure_s = _LIGHT[still.shot](simulation, still.view, exposures, rng)
    colour = simulation.sensor.develop(simulation.sensor.expose(light, rng))
    if simulation.config.sensor.encoding == "mono":
        return cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY).astype(np.uint8), exposure_s
    return colour, exposure_s


_Light = Callable[[BoardSimulation, View, Exposures, np.random.Generator], tuple[Float32Array, float]]


def _long(simulation: BoardSimulation, view: View, exposures: Exposures, _: np.random.Generator) -> tuple[Float32Array, float]:
    return simulation.renderer.long_light(view, exposures.long_s), exposures.long_s


def _short(simulation: BoardSimulation, view: View, exposures: Exposures, rng: np.random.Generator) -> tuple[Float32Array, float]:
    return simulation.renderer.short_light(view, exposures.short_s, rng), exposures.short_s


def _both(simulation: BoardSimulation, view: View, exposures: Exposures, rng: np.random.Generator) -> tuple[Float32Array, float]:
    return simulation.renderer.combined_light(view, exposures, rng), exposures.long_s


_LIGHT: dict[Shot, _Light] = {Shot.LONG: _long, Shot.SHORT: _short, Shot.COMBINED: _both}
