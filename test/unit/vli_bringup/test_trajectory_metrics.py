"""Trajectory figures: as evo computes them, and by definition on cases whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PoseTrajectory3D
from trajectories import FRAME_NS, disturbed, moved, part, wavy

from vli_bringup.trajectory_metrics import (
    Association,
    TrajectoryFigures,
    absolute_drift,
    align_poses,
    associate,
    path_length,
    poses_share,
    trajectory_errors,
    trajectory_figures,
)
from vli_bringup.tum import Trajectory
from vli_common.errors import InputError
from vli_common.geometry import inverse, pose, so3_exp

T_MAP_TRUTH = pose(so3_exp(np.array([0.4, -0.9, 1.3])), np.array([0.5, -2.0, 0.1]))
NO_PASSES = np.empty((0, 2), dtype=np.int64)


def evo_pair(estimate: Trajectory, truth: Trajectory) -> tuple[PoseTrajectory3D, PoseTrajectory3D]:
    seconds = (truth.stamps_ns - truth.stamps_ns[0]) / 1e9
    pair = [PoseTrajectory3D(poses_se3=list(t.poses.copy()), timestamps=seconds) for t in (truth, estimate)]
    return pair[0], pair[1]


def evo_error(relation: metrics.PoseRelation, truth: PoseTrajectory3D, estimate: PoseTrajectory3D) -> metrics.APE:
    ape = metrics.APE(relation)
    ape.process_data((truth, estimate))
    return ape


def figures_of(estimate: Trajectory, truth: Trajectory, passes: np.ndarray = NO_PASSES) -> TrajectoryFigures:
    pairs = associate(estimate, truth)
    errors = trajectory_errors(pairs, align_poses(pairs.estimate, pairs.truth))
    return trajectory_figures(pairs, errors, truth, passes)


@pytest.mark.parametrize("seed", range(5))
def test_translation_is_as_evo_computes_it(seed: int) -> None:
    truth = wavy()
    estimate = moved(disturbed(truth, seed), T_MAP_TRUTH, 1.01)
    reference, aligned = evo_pair(estimate, truth)
    aligned.align(reference)
    ape = evo_error(metrics.PoseRelation.translation_part, reference, aligned)
    figures = figures_of(estimate, truth)
    assert figures.translation_rmse_mm / 1e3 == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)
    assert figures.translation_max_mm / 1e3 == pytest.approx(ape.get_statistic(metrics.StatisticsType.max), abs=1e-9)
    assert figures.path_length_m == pytest.approx(reference.path_length, abs=1e-9)
    assert figures.drift_percent == pytest.approx(
        100 * ape.get_statistic(metrics.StatisticsType.max) / reference.path_length, abs=1e-7
    )


@pytest.mark.parametrize("seed", range(5))
def test_scale_is_as_evo_computes_it(seed: int) -> None:
    truth = wavy()
    estimate = moved(disturbed(truth, seed), T_MAP_TRUTH, 1.03)
    reference, aligned = evo_pair(estimate, truth)
    _, _, scale = aligned.align(reference, correct_scale=True)
    assert figures_of(estimate, truth).scale == pytest.approx(scale, abs=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_rotation_is_the_angle_that_evo_computes_after_our_alignment(seed: int) -> None:
    truth = wavy()
    estimate = moved(disturbed(truth, seed), T_MAP_TRUTH)
    reference, aligned = evo_pair(estimate, truth)
    aligned.transform(align_poses(estimate.poses, truth.poses))
    ape = evo_error(metrics.PoseRelation.rotation_angle_rad, reference, aligned)
    figures = figures_of(estimate, truth)
    assert figures.rotation_rmse_rad == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)
    assert figures.rotation_max_rad == pytest.approx(ape.get_statistic(metrics.StatisticsType.max), abs=1e-9)


def test_a_trajectory_that_is_only_moved_has_no_error() -> None:
    truth = wavy()
    figures = figures_of(moved(truth, T_MAP_TRUTH), truth)
    assert figures.translation_max_mm < 1e-9
    assert figures.rotation_max_rad < 1e-7
    assert abs(figures.scale_error_percent) < 1e-9


def test_a_map_that_is_too_large_has_a_positive_scale_error() -> None:
    truth = wavy()
    assert figures_of(moved(truth, T_MAP_TRUTH, 1.004), truth).scale_error_percent == pytest.approx(0.4, abs=1e-9)
    assert figures_of(moved(truth, T_MAP_TRUTH, 0.996), truth).scale_error_percent == pytest.approx(-0.4, abs=1e-9)


def test_tilt_is_the_angle_between_the_verticals_whatever_the_heading() -> None:
    truth = wavy()
    heading, tilt = so3_exp(np.array([0, 0, 2.1])), so3_exp(np.array([0.009, 0, 0]))
    estimate = moved(truth, pose(heading @ tilt, np.array([1.0, 2.0, 3.0])))
    assert figures_of(estimate, truth).tilt_rad == pytest.approx(0.009, abs=1e-9)


def test_four_points_a_pose_fix_the_roll_that_a_straight_path_leaves_free() -> None:
    x = np.linspace(0, 0.2, 50)
    truth = Trajectory(FRAME_NS * np.arange(50), pose(np.tile(np.eye(3), (50, 1, 1)), np.stack([x, 0 * x, 0 * x], axis=1)))
    estimate = moved(truth, T_MAP_TRUTH)
    np.testing.assert_allclose(align_poses(estimate.poses, truth.poses), inverse(T_MAP_TRUTH), atol=1e-12)
    assert figures_of(estimate, truth).rotation_max_rad < 1e-7


def test_a_constant_turn_of_the_camera_is_a_rotation_error_to_its_full_size() -> None:
    truth = wavy()
    wrong = truth.poses.copy()
    wrong[::2] = wrong[::2] @ pose(so3_exp(np.array([0, 0, 0.02])), np.zeros(3))
    wrong[1::2] = wrong[1::2] @ pose(so3_exp(np.array([0, 0, -0.02])), np.zeros(3))
    figures = figures_of(Trajectory(truth.stamps_ns, wrong), truth)
    assert figures.rotation_rmse_rad == pytest.approx(0.02, rel=1e-2)
    assert figures.rotation_drift_rad_per_m == pytest.approx(figures.rotation_max_rad / path_length(truth, 0, 2**62))


def test_absolute_drift_takes_the_first_error_of_each_pass_off() -> None:
    x = np.linspace(0, 1.0, 101)
    truth = Trajectory(10_000_000 * np.arange(101), pose(np.eye(3), np.stack([x, 0 * x, 0 * x], axis=1)))
    errors = np.zeros((101, 3))
    errors[:51, 1] = 7e-3 + np.linspace(0, 1e-3, 51)
    errors[51:, 2] = -5e-3 - np.linspace(0, 3e-3, 50)
    passes = truth.stamps_ns[[[0, 50], [51, 100]]]
    # 1 mm over 0.50 m and 3 mm over 0.49 m, whatever the error the passes begin with.
    assert absolute_drift(errors, truth.stamps_ns, truth, passes) == pytest.approx((1e-3 / 0.50 + 3e-3 / 0.49) / 2)


def test_a_pass_without_poses_does_not_count() -> None:
    truth = wavy()
    errors = np.linspace(0, 1e-3, len(truth))[:, None] * [1.0, 0, 0]
    inside = truth.stamps_ns[[[0, len(truth) - 1]]]
    elsewhere = inside + 10**12
    alone = absolute_drift(errors, truth.stamps_ns, truth, inside)
    assert alone == pytest.approx(1e-3 / path_length(truth, 0, 2**62))
    assert absolute_drift(errors, truth.stamps_ns, truth, np.concatenate([inside, elsewhere])) == alone
    assert absolute_drift(errors, truth.stamps_ns, truth, elsewhere) is None
    assert absolute_drift(errors, truth.stamps_ns, truth, NO_PASSES) is None


def test_stamps_of_the_same_instant_take_the_truth_as_it_is() -> None:
    truth = wavy()
    estimate = part(truth, slice(20, None, 2))
    rounded = Trajectory(estimate.stamps_ns // 1000 * 1000, estimate.poses)
    pairs = associate(rounded, truth)
    np.testing.assert_array_equal(pairs.truth, estimate.poses)
    assert pairs.unmatched == 0


def test_truth_of_another_beat_is_interpolated() -> None:
    fine = wavy(4001, FRAME_NS // 10)
    truth, estimate = part(fine, slice(0, None, 10)), part(fine, slice(3, 3900, 10))
    pairs = associate(estimate, truth)
    assert len(pairs.stamps_ns) == len(estimate)
    assert np.abs(pairs.truth[:, :3, 3] - estimate.positions).max() < 1e-6
    assert np.abs(pairs.truth[:, :3, :3] - estimate.poses[:, :3, :3]).max() < 1e-5


def test_poses_outside_of_the_truth_and_in_its_gaps_are_left_out_and_counted() -> None:
    fine = wavy(400)
    truth = part(fine, np.r_[100:200, 250:300])
    estimate = part(Trajectory(fine.stamps_ns + FRAME_NS // 3, fine.poses), slice(None))
    pairs = associate(estimate, truth)
    assert len(pairs.stamps_ns) == 99 + 49
    assert pairs.unmatched == 400 - 148


def test_the_length_is_that_of_the_truth_over_the_poses() -> None:
    truth = wavy()
    pairs: Association = associate(part(truth, slice(100, 301, 2)), truth)
    steps = np.linalg.norm(np.diff(truth.positions[100:301], axis=0), axis=1)
    assert pairs.path_length_m == pytest.approx(steps.sum(), abs=1e-15)


def test_no_overlap_in_time_names_both_spans() -> None:
    truth = wavy()
    late = Trajectory(truth.stamps_ns + 60_000_000_000, truth.poses)
    with pytest.raises(
        InputError, match=r"do not overlap in time: '1700000060.123 … 1700000066.773 s' against '1700000000.123 … "
    ):
        associate(late, truth)


@pytest.mark.parametrize("count", [1, 2])
def test_a_truth_that_is_too_short_is_told(count: int) -> None:
    truth = wavy()
    with pytest.raises(InputError, match=f"only '{count}' poses have a truth, expected 3"):
        associate(truth, part(truth, slice(count)))


def test_a_truth_that_does_not_move_is_told() -> None:
    still = Trajectory(FRAME_NS * np.arange(9), np.tile(np.eye(4), (9, 1, 1)))
    with pytest.raises(InputError, match="does not move"):
        figures_of(still, still)


def test_the_share_counts_long_frames_only_and_from_the_given_time_on() -> None:
    truth = wavy(601)  # 10 s; the even frames are long
    long = truth.stamps_ns[::2]
    assert poses_share(long, truth.stamps_ns, 0.0) == 1.0
    assert poses_share(long[45:], truth.stamps_ns, 0.0) == pytest.approx(256 / 301)
    assert poses_share(long[45:], truth.stamps_ns, 1.5) == 1.0
    lost = np.delete(long, np.arange(200, 220))
    assert poses_share(lost, truth.stamps_ns, 0.0) == pytest.approx(281 / 301)
    assert poses_share(lost[:-50], truth.stamps_ns, 0.0) == pytest.approx(231 / 301)
    assert poses_share(long, truth.stamps_ns, 11.0) is None


def test_the_share_holds_where_images_are_missing_from_the_recording() -> None:
    stamps = wavy(601).stamps_ns
    there = np.delete(stamps, [100, 101, 102, 333])
    long = np.intersect1d(there, stamps[1::2])
    assert poses_share(long, there, 0.0) == 1.0
    assert poses_share(long[:-30], there, 0.0) == pytest.approx(1 - 30 / len(long))


def test_the_share_follows_the_trajectory_where_truth_has_a_beat_of_its_own() -> None:
    arm = wavy(5001, 2_000_000).stamps_ns  # 500 Hz, 10 s
    frames = arm[0] + np.arange(0, 10_000_000_000, 33_333_333)
    assert poses_share(frames, arm, 0.0) == 1.0
    assert poses_share(frames[30:], arm, 0.0) == pytest.approx(1 - 30 / len(frames))
    assert poses_share(np.delete(frames, slice(100, 130)), arm, 0.0) == pytest.approx(1 - 30 / len(frames))
