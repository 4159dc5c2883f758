"""Intervals: as often right as they say, and wide where the views leave the plane open."""

from __future__ import annotations

import numpy as np
from laser_sets import CAMERA, PLANE, views

from vli_calibration.bootstrap import simultaneous_half_widths
from vli_calibration.laser_joint import JointProblem, JointSolution, ReducedSystem
from vli_common.arrays import FloatArray

SEEDS = 20


def half_widths(solution: JointSolution) -> FloatArray:
    outputs = np.zeros((4, len(solution.free)))
    outputs[:, -3:] = solution.plane.vector_jacobian()
    return simultaneous_half_widths(solution.systems, outputs[:, solution.free])


def test_the_whole_plane_lies_in_its_intervals_in_seventeen_of_twenty_sets() -> None:
    inside, tilts, shifts = 0, [], []
    for seed in range(SEEDS):
        solution = JointProblem(views(14, 100 + seed), True, np.full(8, np.inf)).solve(CAMERA, PLANE)
        width = half_widths(solution)
        inside += bool((np.abs(solution.plane.vector - PLANE.vector) <= width).all())
        tilts.append(np.degrees(np.linalg.norm(width[:3])))
        shifts.append(width[3])
    assert inside >= 17
    assert np.median(shifts) < 1e-4


def test_more_images_make_them_narrower() -> None:
    few, many = (half_widths(JointProblem(views(count, 7), True, np.zeros(8)).solve(CAMERA, PLANE)) for count in (8, 32))
    assert (many < few).all()
    assert (many > 0).all()


def test_they_are_the_same_every_time() -> None:
    solution = JointProblem(views(10, 8), True, np.zeros(8)).solve(CAMERA, PLANE)
    np.testing.assert_array_equal(half_widths(solution), half_widths(solution))


def test_for_a_mean_of_normal_samples_they_are_near_students_t() -> None:
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(200):
        values = rng.normal(size=10)
        systems = [ReducedSystem(np.eye(1), np.array([values.mean() - value])) for value in values]
        inside += abs(values.mean()) <= simultaneous_half_widths(systems, np.eye(1), 199)[0]
    assert 0.9 <= inside / 200 <= 0.995
