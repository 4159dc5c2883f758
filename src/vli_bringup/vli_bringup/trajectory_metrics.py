"""Trajectory figures, as docs/evaluation defines them: RMSE, maximum, drift, absolute drift and scale.

Positions are aligned as ``evo`` does (Umeyama, 1991). Rotations are aligned on four points a pose, so that orientation counts: on
a straight scan, positions alone leave the roll free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vli_bringup.tum import Trajectory
from vli_common.arrays import BoolArray, FloatArray, IntArray
from vli_common.errors import InputError
from vli_common.geometry import align, interpolate, so3_log, transform
from vli_common.types import NANOSECONDS

EXACT_NS = 10_000
"""Stamps nearer than this are the same instant (text with six decimals loses up to 0.5 µs)."""
MAX_GAP_NS = 100_000_000
"""Truth is interpolated over gaps up to this."""
MIN_POSES = 3
LEVER_M = 0.030
"""Length of the axes whose tips align the orientation: the working distance of the sensor."""


@dataclass(frozen=True, slots=True)
class Association:
    """Poses of an estimate and the truth at the same instants.

    Args:
        stamps_ns: (N,) int64.
        estimate: (N, 4, 4), ``T_map_camera``.
        truth: (N, 4, 4), ``T_truth_camera``.
        path_length_m: length of the whole-rate truth between the first and the last of the stamps.
        unmatched: poses of the estimate that lie outside of the truth, or in a gap of it.
    """

    stamps_ns: IntArray
    estimate: FloatArray
    truth: FloatArray
    path_length_m: float
    unmatched: int


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Errors over time, in the frame of the truth.

    Args:
        stamps_ns: (N,) int64.
        positions: (N, 3), estimate aligned by SE(3) on positions, metres.
        truth: (N, 3), metres.
        translation: (N, 3), ``positions − truth``, metres.
        rotation: (N, 3), rotation vectors ``Log(R_aligned R_truthᵀ)``, aligned on four points a pose, radians.
    """

    stamps_ns: IntArray
    positions: FloatArray
    truth: FloatArray
    translation: FloatArray
    rotation: FloatArray


@dataclass(frozen=True, slots=True)
class TrajectoryFigures:
    """Figures of one trajectory; the field names are the keys of the JSON report.

    Args:
        poses: poses in the file.
        poses_matched: poses that have a truth.
        path_length_m: length of the truth over the matched poses.
        translation_rmse_mm, translation_max_mm: after SE(3) alignment of positions.
        drift_percent: maximum over path length.
        absolute_drift_percent: the error vector at each pass's first pose subtracted, maximum over the pass's length, mean over
            passes; None without passes.
        scale: Sim(3) factor from estimate to truth, as ``evo`` prints it.
        scale_error_percent: size of the estimate against the truth, 100 (1 / scale − 1): positive where it is too large.
        rotation_rmse_rad, rotation_max_rad: angle of the rotation error after SE(3) on four points a pose.
        rotation_drift_rad_per_m: maximum over path length.
        absolute_rotation_drift_rad_per_m: the same with the error at each pass's first pose taken off; None without passes.
        tilt_rad: angle between the z axes of truth and estimate, both meant to be vertical.
    """

    poses: int
    poses_matched: int
    path_length_m: float
    translation_rmse_mm: float
    translation_max_mm: float
    drift_percent: float
    absolute_drift_percent: float | None
    scale: float
    scale_error_percent: float
    rotation_rmse_rad: float
    rotation_max_rad: float
    rotation_drift_rad_per_m: float
    absolute_rotation_drift_rad_per_m: float | None
    tilt_rad: float


def associate(estimate: Trajectory, truth: Trajectory) -> Association:
    """Return the poses of ``estimate`` with the truth at their stamps: of the same instant where there is one, else interpolated.

    Raises:
        InputError: the two do not overlap in time, or in fewer than three poses.
    """
    after = np.clip(np.searchsorted(truth.stamps_ns, estimate.stamps_ns), 1, max(len(truth) - 1, 1))
    low, high = after - 1, np.minimum(after, len(truth) - 1)
    to_low, to_high = estimate.stamps_ns - truth.stamps_ns[low], truth.stamps_ns[high] - estimate.stamps_ns
    nearest = np.where(np.abs(to_low) <= np.abs(to_high), low, high)
    exact = np.abs(estimate.stamps_ns - truth.stamps_ns[nearest]) <= EXACT_NS
    between = ~exact & (to_low > 0) & (to_high > 0) & (to_low + to_high <= MAX_GAP_NS)
    at_stamps = truth.poses[nearest].copy()
    if between.any():
        alpha = to_low[between] / (to_low + to_high)[between]
        at_stamps[between] = interpolate(truth.poses[low[between]], truth.poses[high[between]], alpha)
    matched = exact | between
    _check_overlap(estimate, truth, int(matched.sum()))
    stamps = estimate.stamps_ns[matched]
    length = path_length(truth, int(stamps[0]), int(stamps[-1]))
    return Association(stamps, estimate.poses[matched], at_stamps[matched], length, int((~matched).sum()))


def _check_overlap(estimate: Trajectory, truth: Trajectory, matched: int) -> None:
    if matched == 0:
        raise InputError(
            f"trajectory and truth do not overlap in time: '{estimate.span}' against '{truth.span}', expected one clock"
        )
    if matched < MIN_POSES:
        raise InputError(
            f"only '{matched}' poses have a truth, expected {MIN_POSES}: trajectory '{estimate.span}', truth '{truth.span}'"
        )


def path_length(truth: Trajectory, from_ns: int, to_ns: int) -> float:
    """Return the length in metres of ``truth`` between two stamps (those of EXACT_NS beyond count as inside)."""
    inside = (truth.stamps_ns >= from_ns - EXACT_NS) & (truth.stamps_ns <= to_ns + EXACT_NS)
    return float(np.linalg.norm(np.diff(truth.positions[inside], axis=0), axis=1).sum())


def align_poses(estimate: FloatArray, truth: FloatArray, lever_m: float = LEVER_M) -> FloatArray:
    """Return T_truth_map (4, 4) by SE(3) on four points a pose: the centre and ``lever_m`` along each axis.

    Args:
        estimate, truth: (N, 4, 4).
        lever_m: weighs orientation against position.
    """
    source, target = (_four_points(poses, lever_m) for poses in (estimate, truth))
    return align(source, target)[0]


def _four_points(poses: FloatArray, lever_m: float) -> FloatArray:
    """Return (4 N, 3): centres, then tips of the axes."""
    centre = poses[:, :3, 3]
    result: FloatArray = np.concatenate([centre, *(centre + lever_m * poses[:, :3, axis] for axis in range(3))])
    return result


def trajectory_errors(pairs: Association, T_truth_map: FloatArray) -> TrajectoryErrors:
    """Return the errors over time: translation by an SE(3) alignment of the positions, rotation by ``T_truth_map`` (4, 4)."""
    truth = pairs.truth[:, :3, 3]
    T_positions, _ = align(pairs.estimate[:, :3, 3], truth)
    positions = transform(T_positions, pairs.estimate[:, :3, 3])
    rotation = T_truth_map[:3, :3] @ pairs.estimate[:, :3, :3] @ np.swapaxes(pairs.truth[:, :3, :3], 1, 2)
    return TrajectoryErrors(pairs.stamps_ns, positions, truth, positions - truth, so3_log(rotation))


def absolute_drift(errors: FloatArray, stamps_ns: IntArray, truth: Trajectory, passes_ns: IntArray) -> float | None:
    """Return the absolute drift: error vector at each pass's first pose subtracted, maximum norm over length, mean over passes.

    Args:
        errors: (N, 3), of translation (metres) or rotation (rotation vectors, radians).
        stamps_ns: (N,) int64.
        truth: gives the length of each pass, from its first to its last pose.
        passes_ns: (P, 2) int64, first and last stamp of each pass.

    Returns:
        Error per metre, or None where no pass holds two poses and some motion.
    """
    drifts = []
    for start, end in passes_ns:
        inside = (stamps_ns >= start) & (stamps_ns <= end)
        if inside.sum() < 2:
            continue
        length = path_length(truth, *stamps_ns[inside][[0, -1]])
        if length > 0:
            drifts.append(float(np.linalg.norm(errors[inside] - errors[inside][0], axis=1).max()) / length)
    return float(np.mean(drifts)) if drifts else None


def trajectory_figures(pairs: Association, errors: TrajectoryErrors, truth: Trajectory, passes_ns: IntArray) -> TrajectoryFigures:
    """Return the figures of one trajectory.

    Args:
        pairs, errors: of this trajectory.
        truth: at its full rate, for the lengths.
        passes_ns: (P, 2) int64; P is zero where no passes are known.

    Raises:
        InputError: the truth does not move, so that drift and scale are undefined.
    """
    if pairs.path_length_m <= 0:
        raise InputError("the truth does not move over the poses of the trajectory: path length '0', expected motion")
    _, scale = align(pairs.estimate[:, :3, 3], pairs.truth[:, :3, 3], with_scale=True)
    translation, rotation = (np.linalg.norm(e, axis=1) for e in (errors.translation, errors.rotation))
    absolute, absolute_rotation = (
        absolute_drift(e, errors.stamps_ns, truth, passes_ns) for e in (errors.translation, errors.rotation)
    )
    return TrajectoryFigures(
        poses=len(pairs.stamps_ns) + pairs.unmatched,
        poses_matched=len(pairs.stamps_ns),
        path_length_m=pairs.path_length_m,
        translation_rmse_mm=1e3 * rms(translation),
        translation_max_mm=1e3 * float(translation.max()),
        drift_percent=100 * float(translation.max()) / pairs.path_length_m,
        absolute_drift_percent=None if absolute is None else 100 * absolute,
        scale=scale,
        scale_error_percent=100 * (1 / scale - 1),
        rotation_rmse_rad=rms(rotation),
        rotation_max_rad=float(rotation.max()),
        rotation_drift_rad_per_m=float(rotation.max()) / pairs.path_length_m,
        absolute_rotation_drift_rad_per_m=absolute_rotation,
        tilt_rad=_tilt(align_poses(pairs.estimate, pairs.truth)),
    )


def _tilt(T_truth_map: FloatArray) -> float:
    """Return the angle between the two z axes."""
    return float(np.arctan2(np.hypot(T_truth_map[0, 2], T_truth_map[1, 2]), T_truth_map[2, 2]))


def rms(values: FloatArray) -> float:
    """Return the root mean square of an array of any shape."""
    return float(np.sqrt(np.mean(np.square(values))))


def poses_share(estimate_ns: IntArray, truth_ns: IntArray, from_s: float) -> float | None:
    """Return the share of the truth's long frames, from ``from_s`` after its first stamp on, that have a pose.

    The truth has a stamp for every frame, long and short; which are long follows from the beat of the trajectory. Where the truth
    has a beat of its own (a robot arm), the frames are counted by the trajectory's most common interval instead.

    Args:
        estimate_ns: (N,) int64, N ≥ 2.
        truth_ns: (M,) int64, M ≥ 2.
        from_s: time for the start-up, seconds.

    Returns:
        0 to 1, or None where the truth ends before ``from_s``.
    """
    from_ns = int(truth_ns[0] + from_s * NANOSECONDS)
    expected = _long_frames(estimate_ns, truth_ns)
    expected = expected[expected >= from_ns]
    if len(expected) == 0:
        return None
    tolerance = np.median(np.diff(expected)) / 4 if len(expected) > 1 else EXACT_NS
    return float((_distance_to_nearest(expected, estimate_ns) <= tolerance).mean())


def _long_frames(estimate_ns: IntArray, truth_ns: IntArray) -> IntArray:
    """Return the stamps at which a pose is expected."""
    period = float(np.median(np.diff(truth_ns)))
    # Gaps are counted one by one: a product of index and period would slip over minutes.
    beat = np.concatenate([[0], np.cumsum(np.maximum(np.rint(np.diff(truth_ns) / period), 1))]).astype(np.int64)
    index = np.clip(np.searchsorted(truth_ns, estimate_ns - EXACT_NS), 0, len(truth_ns) - 1)
    same: BoolArray = np.abs(truth_ns[index] - estimate_ns) <= EXACT_NS
    if same.sum() >= max(2, 0.9 * len(estimate_ns)):
        pose_beat = beat[index[same]]
        step = int(np.bincount(np.diff(pose_beat)).argmax())
        phase = int(np.bincount(pose_beat % step).argmax())
        long: IntArray = truth_ns[beat % step == phase]
        return long
    period = float(np.median(np.diff(estimate_ns)))
    lead = int((estimate_ns[0] - truth_ns[0]) // period)
    count = int((truth_ns[-1] - estimate_ns[0]) // period)
    result: IntArray = estimate_ns[0] + np.rint(np.arange(-lead, count + 1) * period).astype(np.int64)
    return result


def _distance_to_nearest(stamps_ns: IntArray, others_ns: IntArray) -> IntArray:
    """Return (N,) the distance of each stamp to the nearest of the others."""
    after = np.clip(np.searchsorted(others_ns, stamps_ns), 1, len(others_ns) - 1)
    result: IntArray = np.minimum(np.abs(stamps_ns - others_ns[after - 1]), np.abs(others_ns[after] - stamps_ns))
    return result


def passes_from_seconds(passes: Sequence[Sequence[float]]) -> IntArray:
    """Return (P, 2) int64 nanoseconds of [[start, end], …] in seconds."""
    return np.rint(np.array(passes, dtype=np.float64).reshape(-1, 2) * NANOSECONDS).astype(np.int64)
