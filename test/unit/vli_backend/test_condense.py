"""The condensed visual residuals against brute force."""

from __future__ import annotations

import numpy as np
import pytest

from vli_backend.condense import LandmarkArrays, Quadratic, condense, refine
from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, pose, so3_exp, transform

NO_ROBUST = 1e6
LIMITS = (2.0, 150.0)


def _problem(seed: int = 0, slots: int = 4, count: int = 12, noise: float = 1e-3) -> tuple[LandmarkArrays, FloatArray]:
    rng = np.random.default_rng(seed)
    poses = pose(so3_exp(rng.normal(scale=0.05, size=(slots, 3))), rng.normal(scale=0.004, size=(slots, 3)))
    anchor = rng.integers(0, slots, count)
    points = np.stack([rng.uniform(-0.01, 0.01, count), rng.uniform(-0.01, 0.01, count), rng.uniform(0.025, 0.04, count)], axis=1)
    local = np.stack([transform(inverse(T), points) for T in poses], axis=1)
    rays = local[..., :2] / local[..., 2:] + rng.normal(scale=noise, size=(count, slots, 2))
    rows = np.arange(count)
    depth_sigma = np.where(rng.random((count, slots)) < 0.3, 0.1, 0.0)
    arrays = LandmarkArrays(
        anchor,
        rays[rows, anchor].copy(),
        1 / local[rows, anchor, 2],
        np.tile([30.0, 20.0], (count, 1)),
        rays,
        np.ones((count, slots), np.bool_),
        700.0 * np.eye(2) + np.random.default_rng(9).normal(scale=100.0, size=(count, slots, 2, 2)),
        1 / local[..., 2] + rng.normal(scale=0.05, size=(count, slots)),
        depth_sigma,
    )
    return arrays, poses


def _cost(arrays: LandmarkArrays, poses: FloatArray, cauchy: float) -> float:
    """Σ ρ(residual²) at the optimal depths, straight from the equations."""
    use = np.ones(len(arrays.rho), np.bool_)
    refine(arrays, poses, use, cauchy, LIMITS, iterations=50)
    total = 0.0
    for i, a in enumerate(arrays.anchor):
        point = np.array([*arrays.anchor_ray[i], 1.0]) / arrays.rho[i]
        total += ((arrays.rho[i] - arrays.prior[i, 0]) / arrays.prior[i, 1]) ** 2
        for j in range(len(poses)):
            local = transform(inverse(poses[j]) @ poses[a], point[None])[0]
            if j != a:
                squared = float(((arrays.whitening[i, j] @ (local[:2] / local[2] - arrays.rays[i, j])) ** 2).sum())
                total += cauchy**2 * np.log1p(squared / cauchy**2)
            if arrays.depth_sigma[i, j] > 0:
                squared = float(((1 / local[2] - arrays.depth[i, j]) / arrays.depth_sigma[i, j]) ** 2)
                total += cauchy**2 * np.log1p(squared / cauchy**2)
    return total


def _moved(poses: FloatArray, step: FloatArray) -> FloatArray:
    step = step.reshape(-1, 6)
    return poses @ pose(so3_exp(step[:, :3]), step[:, 3:])


@pytest.mark.parametrize("cauchy", [NO_ROBUST, 1.5])
def test_the_gradient_is_that_of_the_cost_at_optimal_depths(cauchy: float) -> None:
    arrays, poses = _problem()
    use = np.ones(len(arrays.rho), np.bool_)
    refine(arrays, poses, use, cauchy, LIMITS, iterations=50)
    quadratic = condense(arrays, poses, use, cauchy)
    numeric = np.empty(len(quadratic.gradient))
    for k in range(len(numeric)):
        step = np.zeros(len(numeric))
        step[k] = 1e-6
        numeric[k] = (_cost(arrays, _moved(poses, step), cauchy) - _cost(arrays, _moved(poses, -step), cauchy)) / 4e-6
    np.testing.assert_allclose(quadratic.gradient, numeric, atol=5e-4 * np.abs(numeric).max())


def test_the_constant_is_the_cost() -> None:
    arrays, poses = _problem(seed=3)
    expected = _cost(arrays, poses, 1.5)
    assert condense(arrays, poses, np.ones(len(arrays.rho), np.bool_), 1.5).constant == pytest.approx(expected, rel=1e-9)


def test_without_noise_the_hessian_is_that_of_the_cost() -> None:
    arrays, poses = _problem(noise=0.0)
    arrays.depth_sigma[:] = 0.0
    arrays.prior[:, 1] = 1e6
    use = np.ones(len(arrays.rho), np.bool_)
    refine(arrays, poses, use, NO_ROBUST, LIMITS, iterations=50)
    quadratic = condense(arrays, poses, use, NO_ROBUST)
    rng = np.random.default_rng(1)
    for _ in range(5):
        step = rng.normal(size=len(quadratic.gradient)) * 1e-6
        predicted = step @ quadratic.hessian @ step
        assert _cost(arrays, _moved(poses, step), NO_ROBUST) == pytest.approx(predicted, rel=2e-3)


def test_gauss_newton_on_the_quadratic_finds_the_poses() -> None:
    arrays, poses = _problem(noise=0.0, count=40)
    arrays.depth_sigma[:, 0] = 0.1
    start = _moved(poses, np.random.default_rng(5).normal(scale=2e-3, size=6 * len(poses)))
    start[0] = poses[0]
    arrays.depth[:] = np.stack([1 / transform(inverse(T), _points(arrays, poses))[:, 2] for T in poses], axis=1)
    use = np.ones(len(arrays.rho), np.bool_)
    arrays.rho[:] *= 1.3
    for _ in range(8):
        refine(arrays, start, use, NO_ROBUST, LIMITS)
        quadratic = condense(arrays, start, use, NO_ROBUST)
        step = -np.linalg.solve(quadratic.hessian[6:, 6:], quadratic.gradient[6:])
        start = np.concatenate([start[:1], _moved(start[1:], step)])
    np.testing.assert_allclose(start, poses, atol=2e-5)


def _points(arrays: LandmarkArrays, poses: FloatArray) -> FloatArray:
    local = np.concatenate([arrays.anchor_ray, np.ones((len(arrays.rho), 1))], axis=1) / arrays.rho[:, None]
    return transform(poses[arrays.anchor], local)


def test_a_quadratic_in_the_body_frame_predicts_the_same_cost() -> None:
    arrays, poses = _problem(seed=2)
    use = np.ones(len(arrays.rho), np.bool_)
    refine(arrays, poses, use, NO_ROBUST, LIMITS)
    quadratic = condense(arrays, poses, use, NO_ROBUST)
    T_cam_imu = pose(so3_exp(np.array([0.3, -0.2, 1.1])), np.array([0.01, -0.02, 0.03]))
    body = quadratic.in_body_frame(T_cam_imu)
    step = np.random.default_rng(0).normal(scale=1e-7, size=6 * len(poses))
    moved = _moved(poses @ T_cam_imu, step) @ inverse(T_cam_imu)
    change = inverse(poses) @ moved
    camera_step = np.concatenate([_log_rows(change), change[:, :3, 3]], axis=1).reshape(-1)
    assert body.gradient @ step == pytest.approx(quadratic.gradient @ camera_step, rel=1e-4)
    assert step @ body.hessian @ step == pytest.approx(camera_step @ quadratic.hessian @ camera_step, rel=1e-4)


def _log_rows(change: FloatArray) -> FloatArray:
    return np.stack([change[:, 2, 1], change[:, 0, 2], change[:, 1, 0]], axis=1)


def test_quadratics_add_up() -> None:
    one = Quadratic(np.eye(6), np.arange(6.0), 1.0)
    total = one + one
    assert total.constant == 2.0
    np.testing.assert_array_equal(total.hessian, 2 * np.eye(6))
