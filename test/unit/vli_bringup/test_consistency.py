"""Covariances on disk, and whether they are true."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from trajectories import START_NS, moved, part, wavy

from vli_bringup.consistency import (
    HEADER,
    camera_covariance,
    consistency_figures,
    covariance_text,
    position_nees,
    read_covariances,
)
from vli_bringup.trajectory_metrics import Association, associate
from vli_bringup.tum import Trajectory
from vli_common.arrays import FloatArray
from vli_common.errors import InputError
from vli_common.geometry import pose, so3_exp

T_MAP_TRUTH = pose(so3_exp(np.array([0.3, -0.2, 1.3])), np.array([0.5, -2.0, 0.1]))


def covariances(count: int, seed: int = 0) -> FloatArray:
    root = 1e-4 * np.random.default_rng(seed).normal(size=(count, 6, 6))
    return root @ np.swapaxes(root, 1, 2) + 1e-12 * np.eye(6)


def drawn(count: int, truth_scale: float = 1.0) -> tuple[Association, FloatArray]:
    """Return poses in map whose position errors are drawn from their covariances, times ``truth_scale``."""
    truth = part(wavy(count), slice(None))
    known = covariances(count)
    estimate = moved(truth, T_MAP_TRUTH).poses
    rng = np.random.default_rng(1)
    for k in range(1, count):
        estimate[k, :3, 3] += truth_scale * rng.multivariate_normal(np.zeros(3), known[k, :3, :3])
    return associate(Trajectory(truth.stamps_ns, estimate), truth), known


def test_errors_drawn_from_the_covariances_have_a_nees_of_three() -> None:
    pairs, known = drawn(4000)
    assert position_nees(pairs, known).mean() == pytest.approx(3.0, abs=0.15)


def test_errors_twice_as_large_as_reported_have_a_nees_of_twelve() -> None:
    pairs, known = drawn(4000, 2.0)
    assert position_nees(pairs, known).mean() == pytest.approx(12.0, abs=0.6)


def test_the_figures_take_the_covariance_of_the_same_stamp() -> None:
    pairs, known = drawn(300)
    earlier = np.concatenate([[START_NS - 7], pairs.stamps_ns])
    figures = consistency_figures(pairs, earlier, np.concatenate([1e6 * known[:1], known]))
    assert figures.position_nees == pytest.approx(position_nees(pairs, known).mean())
    assert figures.position_sigma_mm == pytest.approx(1e3 * np.sqrt(np.trace(known[-1, :3, :3])))


def test_the_camera_moves_on_the_lever_when_the_body_turns() -> None:
    rng = np.random.default_rng(2)
    T_map_imu, T_imu_camera = pose(so3_exp(rng.normal(size=3)), rng.normal(size=3)), pose(np.eye(3), np.array([0.1, -0.2, 0.05]))
    body = covariances(1, 4)[0]
    samples = []
    for error in rng.multivariate_normal(np.zeros(6), body, 30_000):
        turned = so3_exp(error[3:]) @ T_map_imu[:3, :3]
        camera = T_map_imu[:3, 3] + error[:3] + turned @ T_imu_camera[:3, 3]
        samples.append(np.concatenate([camera - (T_map_imu @ T_imu_camera)[:3, 3], error[3:]]))
    found = camera_covariance(body, T_map_imu, T_imu_camera)
    np.testing.assert_allclose(found, np.cov(np.array(samples).T), atol=0.03 * np.abs(found).max())


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    stamps, known = START_NS + 33_333_333 * np.arange(5), covariances(5)
    path = tmp_path / "covariance.csv"
    path.write_text(covariance_text(dict(zip(stamps.tolist(), known, strict=True))))
    read_stamps, read = read_covariances(path)
    assert read_stamps.tolist() == stamps.tolist()
    np.testing.assert_allclose(read, known, rtol=1e-8)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "begin with '', expected 'stamp,x_x"),
        ("stamp,x\n1.0,2\n", "begin with 'stamp,x', expected"),
        (f"{HEADER}\n1.0,2.0\n", "line 2: '1.0,2.0' is no covariance"),
        (f"{HEADER}\n1.0{',a' * 21}\n", "line 2: .*could not convert"),
    ],
)
def test_a_file_that_is_none_is_named_with_its_line(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "covariance.csv").write_text(content)
    with pytest.raises(InputError, match=message):
        read_covariances(tmp_path / "covariance.csv")


def test_covariances_of_another_run_or_no_covariances_at_all_are_errors() -> None:
    pairs, known = drawn(20)
    with pytest.raises(InputError, match="'20' poses have no covariance"):
        consistency_figures(pairs, pairs.stamps_ns + 1, known)
    with pytest.raises(InputError, match="have no covariance"):
        consistency_figures(pairs, pairs.stamps_ns[:0], known[:0])
    with pytest.raises(InputError, match="not positive definite"):
        consistency_figures(pairs, pairs.stamps_ns, -known)
