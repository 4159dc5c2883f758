"""The camera from corners: truth within the stated deviations, outliers out, and refusals where the views do not suffice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from board_scenes import BOARD, RADTAN4, RADTAN5, SIZE, WIDE, board_pose_at, project, random_poses

from vli_calibration.board_pose import board_pose
from vli_calibration.camera_fit import CameraFit, View, fit_camera
from vli_calibration.camera_quality import remarks, verdict
from vli_calibration.camera_selection import select_camera
from vli_calibration.coverage import coverage
from vli_calibration.lens import LENSES, lens_of
from vli_calibration.report import Verdict
from vli_calibration.types import Detection
from vli_common.arrays import FloatArray
from vli_common.camera import CameraModel
from vli_common.errors import InputError

CAMERAS = {"radtan4": RADTAN4, "radtan5": RADTAN5, "equidistant": WIDE}


def views_of(camera: CameraModel, poses: list[FloatArray], rng: np.random.Generator, sigma: float = 0.15) -> list[View]:
    ids = np.arange(len(BOARD.points))
    return [
        View(f"im{i}.png", Detection(ids, project(camera, T, BOARD.points) + rng.normal(0, sigma, (len(ids), 2))))
        for i, T in enumerate(poses)
    ]


def scene(model: str, count: int = 15, seed: int = 0, sigma: float = 0.15) -> list[View]:
    rng = np.random.default_rng(seed)
    return views_of(CAMERAS[model], random_poses(BOARD, CAMERAS[model], count, rng), rng, sigma)


def normalised_errors(fit: CameraFit, camera: CameraModel) -> FloatArray:
    """Return the errors of the parameters (P,) in units of their standard deviations."""
    _, truth = lens_of(camera)
    return (fit.parameters - truth) / fit.sigma


@pytest.mark.parametrize("model", CAMERAS)
def test_the_derivatives_of_every_lens_are_right(model: str) -> None:
    camera = CAMERAS[model]
    lens, parameters = lens_of(camera)
    assert lens.name == model
    pose = np.array([0.2, -0.3, 0.1, -0.01, 0.005, 0.09])
    pixels, by_pose, by_parameters = lens.project(BOARD.points, pose, parameters)
    steps = 1e-6 * np.maximum(np.abs(np.concatenate([pose, parameters])), 1e-2)
    for i, step in enumerate(steps):
        moved = np.concatenate([pose, parameters])
        moved[i] += step
        change = (lens.project(BOARD.points, moved[:6], moved[6:])[0] - pixels).ravel() / step
        assert change == pytest.approx(np.hstack([by_pose, by_parameters])[:, i], rel=1e-2, abs=1e-2 * np.abs(change).max())


@pytest.mark.parametrize("model", CAMERAS)
def test_the_truth_lies_within_the_stated_deviations(model: str) -> None:
    errors = np.array(
        [normalised_errors(fit_camera(scene(model, seed=seed), BOARD, SIZE, model), CAMERAS[model]) for seed in range(4)]
    )
    assert np.sqrt((errors**2).mean()) < 1.5
    fit = fit_camera(scene(model), BOARD, SIZE, model)
    assert fit.rms_px == pytest.approx(0.15 * np.sqrt(2), rel=0.1)
    assert fit.rms_px <= fit.loo_rms_px < 1.3 * fit.rms_px
    assert fit.camera.focal_px == pytest.approx(CAMERAS[model].focal_px, rel=0.01)
    low, high = fit.intervals["fx"]
    assert low < fit.camera.fx < high


def test_disturbed_corners_are_left_out_one_by_one() -> None:
    rng = np.random.default_rng(1)
    views = scene("radtan4")
    spoilt = []
    for view in views:
        bad = rng.choice(54, 5, replace=False)
        pixels = view.detection.pixels.copy()
        pixels[bad] += rng.choice([-1, 1], (5, 2)) * rng.uniform(3, 12, (5, 2))
        spoilt.append((View(view.name, replace(view.detection, pixels=pixels)), bad))
    fit = fit_camera([view for view, _ in spoilt], BOARD, SIZE, "radtan4")
    assert not fit.rejected
    for fitted, (_, bad) in zip(fit.views, spoilt, strict=True):
        assert not fitted.kept[bad].any()
        assert fitted.kept.sum() >= 47
    assert np.abs(normalised_errors(fit, RADTAN4)).max() < 4


def test_a_view_that_does_not_belong_is_rejected_as_a_whole_and_named() -> None:
    views = scene("radtan4", 12)
    rng = np.random.default_rng(2)
    pixels = views[4].detection.pixels + rng.normal(0, 3.0, (54, 2))
    views[4] = View("bad.png", replace(views[4].detection, pixels=pixels))
    fit = fit_camera(views, BOARD, SIZE, "radtan4")
    assert [item.name for item in fit.rejected] == ["bad.png"]
    assert "corners fit" in fit.rejected[0].reason or "what the other views predict" in fit.rejected[0].reason
    assert len(fit.views) == 11
    assert "bad.png" not in fit.T_cam_board


def test_a_blurred_view_counts_for_less_but_stays() -> None:
    views = scene("radtan4", 12)
    rng = np.random.default_rng(3)
    pixels = views[4].detection.pixels + rng.normal(0, 0.35, (54, 2))
    views[4] = View("blurred.png", replace(views[4].detection, pixels=pixels))
    fit = fit_camera(views, BOARD, SIZE, "radtan4")
    assert not fit.rejected
    assert np.abs(normalised_errors(fit, RADTAN4)).max() < 4


def test_too_few_or_parallel_views_are_refused() -> None:
    with pytest.raises(InputError, match="found in '4' views, expected 5 or more"):
        fit_camera(scene("radtan4", 4), BOARD, SIZE, "radtan4")
    rng = np.random.default_rng(4)
    flat = [
        board_pose_at(BOARD, d, np.zeros(2), rng.uniform(-0.1, 0.1, 2), spin)
        for d, spin in zip(np.linspace(0.09, 0.14, 8), range(8), strict=True)
    ]
    with pytest.raises(InputError, match=r"all 8 views are parallel \(tilts within '[\d.]+' degrees\).*tilted by 20 to 45"):
        fit_camera(views_of(RADTAN4, flat, rng), BOARD, SIZE, "radtan4")


@pytest.mark.parametrize("model", ["radtan4", "equidistant"])
def test_auto_takes_the_lens_that_was_there(model: str) -> None:
    selection = select_camera(scene(model, 14, seed=5), BOARD, SIZE)
    assert selection.fit.model == model
    assert selection.sentence.startswith(f"{model} predicts images left out to 0.2")
    assert {candidate.model for candidate in selection.candidates} == set(LENSES)


def test_an_explicit_model_is_the_only_one() -> None:
    views = scene("radtan4", 10)
    assert select_camera(views, BOARD, SIZE, "equidistant").fit.model == "equidistant"
    assert select_camera(views, BOARD, SIZE, "radtan").fit.model.startswith("radtan")


def test_a_wrong_square_size_changes_the_distances_and_nothing_else() -> None:
    from vli_calibration.targets import parse_target

    views = scene("radtan4", 10)
    right = fit_camera(views, BOARD, SIZE, "radtan4")
    wrong = fit_camera(views, parse_target("chessboard:9x6:0.01"), SIZE, "radtan4")
    assert wrong.parameters == pytest.approx(right.parameters, rel=1e-4, abs=1e-5)
    for name, T in right.T_cam_board.items():
        assert wrong.T_cam_board[name][:3, 3] == pytest.approx(2 * T[:3, 3], rel=1e-3, abs=1e-6)


def test_a_boards_pose_is_found_past_disturbed_corners() -> None:
    rng = np.random.default_rng(6)
    T = random_poses(BOARD, WIDE, 1, rng)[0]
    pixels = project(WIDE, T, BOARD.points) + rng.normal(0, 0.1, (54, 2))
    pixels[10:16] += 6.0
    found = board_pose(WIDE, BOARD.points, pixels)
    assert found is not None
    assert not found.kept[10:16].any()
    assert found.T_cam_board == pytest.approx(T, abs=2e-3)
    assert found.rms_px < 0.2


def test_the_verdict_asks_for_what_is_missing() -> None:
    good = fit_camera(scene("radtan4", 25), BOARD, SIZE, "radtan4")
    seen = coverage(good.views, BOARD.points, SIZE)
    assert seen.share > 0.5
    level, _ = verdict(good, seen)
    assert level in (Verdict.GOOD, Verdict.USABLE)
    rng = np.random.default_rng(7)
    narrow = [
        board_pose_at(BOARD, 0.11, np.array([t, 0.0]), np.zeros(2), 0.1 * i) for i, t in enumerate(np.linspace(-0.3, 0.3, 7))
    ]
    weak = fit_camera(views_of(RADTAN4, narrow, rng), BOARD, SIZE, "radtan4")
    text = " ".join(remarks(weak, coverage(weak.views, BOARD.points, SIZE)))
    assert "tilted about the vertical axis" in text
    assert "only 7 views" in text
    assert "take some nearer and further" in text
    assert verdict(weak, coverage(weak.views, BOARD.points, SIZE))[0] is not Verdict.GOOD
