"""Structure from motion over the first keyframes of a start in motion, metric from the beginning by the laser."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import gtsam
import numpy as np

from vli_backend.condense import Quadratic, condense, refine
from vli_backend.config import BackEndConfig
from vli_backend.frame_pose import solve_frame_pose
from vli_backend.initialisation import bundle_adjust, chain_rotations
from vli_backend.landmarks import LandmarkTable
from vli_backend.laser_depth import measure_keyframes
from vli_backend.track_noise import whitening
from vli_backend.window import FrameRecord, Window, close_interval
from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration
from vli_common.camera import CameraModel
from vli_common.geometry import interpolate, pose
from vli_common.types import LaserScan, Tracks

_ROUNDS = 3
"""Laser depths need poses and poses need laser depths: they alternate."""

_MIN_DEPTHS = 4


@dataclass(frozen=True)
class Structure:
    """Poses in a world that is the first camera's; ``problem`` says why there are none.

    Args:
        T_world_imu: (K, 4, 4), of the keyframes.
        between: K − 1 arrays (M, 4, 4) ``T_world_camera`` of the frames between two of them.
    """

    T_world_imu: FloatArray
    between: list[FloatArray]
    problem: str = ""


def structure_from_motion(
    calibration: Calibration,
    config: BackEndConfig,
    tracks: list[Tracks],
    between: list[list[Tracks]],
    imu: list[gtsam.PreintegratedCombinedMeasurements],
    scans: list[LaserScan],
) -> Structure:
    """Return metric poses from tracks, gyro rotations and stripes.

    Args:
        calibration: camera, IMU, laser.
        config: parameters.
        tracks: of the K keyframes.
        between: K − 1 lists, of the frames after a keyframe, up to and with the next one.
        imu: the K − 1 preintegrations between them (only their rotations are used).
        scans: stripes taken meanwhile.
    """
    T_cam_imu = calibration.T_cam_imu if calibration.T_cam_imu is not None else np.eye(4)
    focal = calibration.camera.focal_px
    rotations = chain_rotations(list(imu), T_cam_imu)
    parallax = parallax_px(tracks, rotations, focal)
    if parallax < config.start_parallax_px:
        return _failed(f"{parallax:.0f} px of parallax, {config.start_parallax_px:.0f} are needed: move sideways")
    table = LandmarkTable(max(len(tracks), 2))
    guess = 1.0 / float(np.median(np.concatenate([scan.points[:, 2] for scan in scans])))
    limits = (guess / 6.0, guess * 6.0)
    poses = chain_keyframes(table, config, tracks, rotations, guess, calibration.camera, limits)
    use = table.usable

    def linearise(T_world_camera: FloatArray) -> Quadratic:
        refine(table.arrays, T_world_camera, use, config.cauchy, limits)
        return condense(table.arrays, T_world_camera, use, config.cauchy)

    measured = 0
    for _ in range(_ROUNDS):
        measured = _measure(table, config, tracks, poses, scans, focal)
        poses = _to_scale(table, poses) if measured >= _MIN_DEPTHS else poses
        poses, _ = bundle_adjust(linearise, poses, config.start_iterations)
    if measured < _MIN_DEPTHS:
        return _failed(f"{measured} features near the stripe, {_MIN_DEPTHS} are needed")
    inner = [frame_poses(config, table, poses, k, tracks[k], frames, calibration.camera) for k, frames in enumerate(between)]
    return Structure(poses @ T_cam_imu, inner)


def _failed(problem: str) -> Structure:
    return Structure(np.empty((0, 4, 4)), [], problem)


def parallax_px(tracks: list[Tracks], rotations: FloatArray, focal_px: float) -> float:
    """Return the median rotation-compensated shift between the first and the last keyframe they share enough with."""
    first = tracks[0]
    best = 0.0
    for other, rotation in zip(tracks[1:], rotations[1:], strict=True):
        _, a, b = np.intersect1d(first.ids, other.ids, assume_unique=True, return_indices=True)
        if len(a) < 10:
            break
        turned = np.concatenate([other.rays[b], np.ones((len(b), 1))], axis=1) @ rotation.T
        best = max(best, float(np.median(np.linalg.norm(turned[:, :2] / turned[:, 2:] - first.rays[a], axis=1))) * focal_px)
    return best


def chain_keyframes(
    table: LandmarkTable,
    config: BackEndConfig,
    tracks: list[Tracks],
    rotations: FloatArray,
    guess: float,
    camera: CameraModel,
    limits: tuple[float, float],
) -> FloatArray:
    """Return camera poses (K, 4, 4) by PnP from keyframe to keyframe; the landmarks' depths follow each step."""
    poses = [np.eye(4)]
    for k, track in enumerate(tracks):
        white = whitening(camera, track, config.pixel_sigma)
        if k > 0:
            predicted = pose(poses[-1][:3, :3] @ rotations[k - 1].T @ rotations[k], poses[-1][:3, 3])
            rows = table.rows_of(track.ids)
            seen = np.flatnonzero(rows >= 0)
            arrays = table.arrays
            anchors = np.stack(poses)[arrays.anchor[rows[seen]]]
            rays = np.concatenate([arrays.anchor_ray[rows[seen]], np.ones((len(seen), 1))], axis=1)
            directions = np.einsum("nij,nj->ni", anchors[:, :3, :3], rays) / arrays.rho[rows[seen], None]
            prior = np.diag(np.repeat([0.02**-2, guess**2], 3))
            found = solve_frame_pose(
                predicted, prior, directions + anchors[:, :3, 3], 0.1 * directions, track.rays[seen], white[seen], 2.0
            )
            poses.append(found.T_map_camera)
        table.add_keyframe(track.ids, track.rays, white, np.zeros(len(track), np.bool_), guess)
        refine(table.arrays, np.stack(poses), table.usable, config.cauchy, limits)
    return np.stack(poses)


def _to_scale(table: LandmarkTable, poses: FloatArray) -> FloatArray:
    """Scale landmarks and poses (K, 4, 4) by the median of what the laser measured over what vision has; return the poses.

    The adjustment would not find a scale that is far off: to its robust loss, all that the laser says would be outliers.
    """
    arrays = table.arrays
    rows, slots = np.nonzero(arrays.depth_sigma > 0)
    rays = np.concatenate([arrays.anchor_ray[rows], np.ones((len(rows), 1))], axis=1) / arrays.rho[rows, None]
    anchors = poses[arrays.anchor[rows]]
    points = np.einsum("nij,nj->ni", anchors[:, :3, :3], rays) + anchors[:, :3, 3]
    depths = np.einsum("ni,ni->n", points - poses[slots, :3, 3], poses[slots, :3, 2])
    factor = float(np.median(1.0 / (arrays.depth[rows, slots] * depths)))
    arrays.rho /= factor
    arrays.prior /= factor
    return np.stack([pose(T[:3, :3], factor * T[:3, 3]) for T in poses])


def frame_poses(
    config: BackEndConfig,
    table: LandmarkTable,
    poses: FloatArray,
    k: int,
    keyframe: Tracks,
    frames: list[Tracks],
    camera: CameraModel,
) -> FloatArray:
    """Return camera poses (M, 4, 4) of frames between keyframes k and k + 1, by PnP on the landmarks.

    Args:
        config: parameters.
        table: of the landmarks.
        poses: (K, 4, 4), of the keyframes.
        k: before the frames.
        keyframe: tracks of keyframe k.
        frames: M of them, and the next keyframe's.
        camera: that took them.
    """
    *inner, following = frames
    points = table.all_points(poses)
    prior = np.diag(np.repeat([0.02**-2, float(np.median(table.arrays.rho)) ** 2], 3))
    found = np.empty((len(inner), 4, 4))
    for at, tracks in enumerate(inner):
        _, rows, columns = np.intersect1d(points.ids, tracks.ids, return_indices=True)
        white = whitening(camera, tracks, config.pixel_sigma)[columns]
        share = (tracks.stamp_ns - keyframe.stamp_ns) / (following.stamp_ns - keyframe.stamp_ns)
        predicted = interpolate(poses[k], poses[k + 1], share)
        spread, rays = points.spread[rows], tracks.rays[columns]
        found[at] = solve_frame_pose(predicted, prior, points.positions[rows], spread, rays, white, config.cauchy).T_map_camera
    return found


def _measure(
    table: LandmarkTable, config: BackEndConfig, tracks: list[Tracks], poses: FloatArray, scans: list[LaserScan], focal: float
) -> int:
    """Set the laser depths of all keyframes at the present poses; return how many landmarks have one."""
    window = Window()
    for k, track in enumerate(tracks):
        pair = [FrameRecord(tracks[i].stamp_ns, poses[i], False) for i in (k - 1, k)] if k else []
        window.append(track.stamp_ns, False, close_interval(pair, scans) if k else None)
    # Poses are rough yet: so are the depth planes.
    rough = dataclasses.replace(config, depth_max_rms=3 * config.depth_max_rms, primary_only=True)
    measure_keyframes(table, window, poses, 0, [], focal, rough)
    return int(np.count_nonzero((table.arrays.depth_sigma > 0).any(axis=1)))
