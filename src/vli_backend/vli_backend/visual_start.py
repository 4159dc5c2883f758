"""A start without the laser: structure from motion up to scale, and its scale from the IMU.

The gyroscope gives the rotations first, so that a flat scene is no degenerate case as it is in two-view geometry; keyframes are
chained by PnP on landmarks at one guessed depth, adjusted together (eq. 3), and every frame between them gets a pose from the
landmarks. :mod:`vli_backend.inertial_alignment` then says how long the path is, which way is down, and how sure that is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vli_backend.condense import Quadratic, condense, refine
from vli_backend.config import BackEndConfig
from vli_backend.inertial_alignment import (
    GRAVITY,
    AlignmentSigmas,
    InertialAlignment,
    VisualInterval,
    align_structure,
)
from vli_backend.initialisation import bundle_adjust, chain_rotations
from vli_backend.landmarks import LandmarkTable
from vli_backend.motion_start import chain_keyframes, frame_poses, parallax_px
from vli_backend.preintegrations import measurements_of
from vli_backend.smoother import KeyframeState
from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration
from vli_common.camera import CameraModel
from vli_common.geometry import inverse, pose, rotation_between
from vli_common.types import FrontEndOutput, Tracks

_VISUAL_ROTATION_RAD = 5e-4
"""What images leave open of a keyframe's attitude in a short window."""

_POSITION_SHARE = 0.3
"""Error of a frame's position in units of one feature's, at the landmarks' depth: many features fix it."""

_NOISE_FACTOR = 2.0
"""On the data sheet's noise densities; what the residuals say comes on top."""


@dataclass(frozen=True)
class VisualStart:
    """States of the keyframes, gravity-aligned, the first at the origin; median depth of the landmarks, metres.

    ``problem`` says why there are none; ``scale_sigma`` is the relative standard deviation of the scale.
    """

    states: list[KeyframeState]
    median_depth: float
    scale_sigma: float
    problem: str = ""


def start_from_vision(
    calibration: Calibration,
    config: BackEndConfig,
    first: Tracks,
    intervals: list[list[FrontEndOutput]],
    guess_m: float,
    scale_sigma: float,
) -> VisualStart:
    """Return metric states of the K keyframes, or why the motion so far does not tell them.

    Args:
        calibration: camera and IMU.
        config: parameters.
        first: tracks of the first keyframe.
        intervals: K − 1 lists of frames after a keyframe, up to and with the next one; each has its preintegration.
        guess_m: a first depth; only how the numbers are scaled depends on it.
        scale_sigma: how well the scale must be known, relative.
    """
    tracks = [first, *(interval[-1].tracks for interval in intervals)]
    T_cam_imu = calibration.T_cam_imu if calibration.T_cam_imu is not None else np.eye(4)
    camera = calibration.camera
    rotations = chain_rotations([measurements_of(interval[-1].preintegration) for interval in intervals], T_cam_imu)
    parallax = parallax_px(tracks, rotations, camera.focal_px)
    if parallax < config.start_parallax_px:
        return _failed(f"{parallax:.0f} px of parallax, {config.start_parallax_px:.0f} are needed: move sideways")
    table, poses = _structure(config, tracks, rotations, guess_m, camera)
    visual = [_interval(config, table, poses, k, tracks[k], interval, T_cam_imu, camera) for k, interval in enumerate(intervals)]
    depth = float(np.median(1.0 / table.arrays.rho[table.usable]))
    T_world_keyframe = pose(poses[:, :3, :3] @ T_cam_imu[:3, :3], poses[:, :3, 3])
    sigmas = alignment_sigmas(calibration, config, depth)
    found = align_structure(T_world_keyframe, visual, inverse(T_cam_imu)[:3, 3], sigmas)
    if problem := _doubt(found, scale_sigma):
        return _failed(problem)
    return VisualStart(_states(poses, found, inverse(T_cam_imu)[:3, 3]), depth * found.scale, found.scale_sigma)


def _structure(
    config: BackEndConfig, tracks: list[Tracks], rotations: FloatArray, guess_m: float, camera: CameraModel
) -> tuple[LandmarkTable, FloatArray]:
    """Return landmarks and camera poses (K, 4, 4) up to scale: chained by PnP, then adjusted."""
    table = LandmarkTable(max(len(tracks), 2))
    limits = (1.0 / (10.0 * guess_m), 10.0 / guess_m)
    poses = chain_keyframes(table, config, tracks, rotations, 1.0 / guess_m, camera, limits)
    use = table.usable

    def linearise(T_world_camera: FloatArray) -> Quadratic:
        refine(table.arrays, T_world_camera, use, config.cauchy, limits)
        return condense(table.arrays, T_world_camera, use, config.cauchy)

    poses, _ = bundle_adjust(linearise, poses, 3 * config.start_iterations)
    table.information = refine(table.arrays, poses, use, config.cauchy, limits)
    return table, poses


def _interval(
    config: BackEndConfig,
    table: LandmarkTable,
    poses: FloatArray,
    k: int,
    keyframe: Tracks,
    frames: list[FrontEndOutput],
    T_cam_imu: FloatArray,
    camera: CameraModel,
) -> VisualInterval:
    """Return the frames between keyframes k and k + 1 with poses from the landmarks."""
    found = frame_poses(config, table, poses, k, keyframe, [frame.tracks for frame in frames], camera)
    T = np.concatenate([found, poses[k + 1 : k + 2]])
    measurements = [measurements_of(frame.preintegration) for frame in frames]
    return VisualInterval(T[:, :3, 3], T[:, :3, :3] @ T_cam_imu[:3, :3], measurements)


def alignment_sigmas(calibration: Calibration, config: BackEndConfig, depth: float) -> AlignmentSigmas:
    """Return what goes into an alignment of a structure with the IMU; ``depth`` is that of its landmarks, in its units."""
    imu = calibration.imu
    accelerometer, gyroscope = (imu.accelerometer_noise_density, imu.gyroscope_noise_density) if imu else (2e-3, 2e-4)
    return AlignmentSigmas(
        _NOISE_FACTOR * accelerometer,
        _NOISE_FACTOR * gyroscope,
        depth * _POSITION_SHARE * config.pixel_sigma / calibration.camera.focal_px,
        _VISUAL_ROTATION_RAD,
        config.accel_bias_sigma,
        config.gyro_bias_sigma,
    )


def _doubt(found: InertialAlignment, scale_sigma: float) -> str:
    """Return why the alignment is not to be believed yet, or nothing."""
    if found.scale <= 0.0 or found.scale_sigma > scale_sigma:
        spread = "unknown" if found.scale <= 0.0 else f"known to {100 * found.scale_sigma:.0f} %"
        return f"scale {spread}, {100 * scale_sigma:.0f} % are needed: move less evenly"
    if abs(found.gravity_norm - GRAVITY) > 0.15 * GRAVITY:
        return f"gravity comes out as {found.gravity_norm:.1f} m/s²"
    return ""


def _states(poses: FloatArray, found: InertialAlignment, lever: FloatArray) -> list[KeyframeState]:
    up = rotation_between(-found.gravity, np.array([0.0, 0.0, 1.0]))
    positions = found.scale * poses[:, :3, 3] - found.rotations @ lever
    return [
        KeyframeState(pose(up @ R, up @ (p - positions[0])), up @ v, found.gyro_bias, found.accel_bias)
        for R, p, v in zip(found.rotations, positions, found.velocities, strict=True)
    ]


def _failed(problem: str) -> VisualStart:
    return VisualStart([], 0.0, np.inf, problem)
