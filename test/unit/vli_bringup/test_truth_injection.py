"""The benchmark's stages that know the truth: stripes and tracks lie on the surface, an ideal IMU measures the motion."""

from __future__ import annotations

import numpy as np
import pytest
from ground_truth import TrueMotion, Truth, load_surface
from injection import ImuTruth, Injection, TrueTracks, bias_of, stripe_offsets, true_stripe

from vli_bringup.tum import Trajectory
from vli_common import ply
from vli_common.calibration import Calibration, LaserCalibration
from vli_common.camera import make_camera
from vli_common.geometry import inverse, pose, so3_exp, transform
from vli_common.types import ImuSample, LaserScan, TrackFlag, Tracks

CAMERA = make_camera("radtan", (360.0, 361.0, 321.0, 238.0), (-0.1, 0.02, 0.0, 0.0), (640, 480))
NORMAL = np.array([0.03, -0.94, -0.34]) / np.linalg.norm([0.03, -0.94, -0.34])
T_CAM_IMU = pose(so3_exp(np.array([0.02, -0.03, 1.5])), np.array([-0.004, 0.006, 0.008]))
CALIBRATION = Calibration(CAMERA, 60.0, T_CAM_IMU, 0, None, LaserCalibration(NORMAL, 0.0118, (0.02, 0.15)))
START_NS, FRAME_NS = 1_000_000_000, 16_666_667
DOWN = np.diag([1.0, -1.0, -1.0])


def camera_pose(t: float) -> np.ndarray:
    turn = so3_exp(0.03 * np.array([np.sin(30 * t), np.sin(23 * t), np.sin(17 * t)]))
    return pose(turn @ DOWN, np.array([0.014 * t, 3e-4 * np.sin(50 * t), 0.035 + 2e-4 * np.cos(40 * t)]))


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    """Return a camera over the plane z = 0."""
    path = tmp_path_factory.mktemp("surface") / "surface.ply"
    corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    ply.write_mesh(path, ply.Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]])))
    stamps = START_NS + FRAME_NS * np.arange(300)
    poses = np.stack([camera_pose((stamp - START_NS) * 1e-9) for stamp in stamps.tolist()])
    return Truth(Trajectory(stamps, poses), load_surface(path), CALIBRATION)


def tracks(stamp_ns: int, ids: np.ndarray, rays: np.ndarray, flag: TrackFlag) -> Tracks:
    count = len(ids)
    pixels = CAMERA.project(np.column_stack([rays, np.ones(count)]))
    flags = np.full(count, int(flag), np.uint8)
    return Tracks(
        stamp_ns, False, False, ids, pixels, rays, np.zeros((count, 2)), np.full(count, 0.1), np.full(count, np.inf), flags
    )


def test_a_true_stripe_lies_on_the_surface_and_in_the_laser_plane(truth: Truth) -> None:
    stamp = START_NS + 7 * FRAME_NS
    v = np.linspace(50, 430, 2000)
    columns = []
    for u in np.linspace(100, 540, 40):
        rays = np.column_stack([CAMERA.unproject(np.column_stack([np.full_like(v, u), v])), np.ones_like(v)])
        gap = truth.depth(stamp, rays[:, :2]) * (rays @ NORMAL) + 0.0118
        columns.append([u, v[np.abs(gap).argmin()]])
    pixels = np.array(columns)
    wrong = pixels + np.random.default_rng(0).normal(size=pixels.shape) * [0.0, 0.5]
    scan = true_stripe(truth, LaserScan(stamp, np.zeros((40, 3)), wrong, np.ones(40), np.full(40, 1e-5)))
    assert len(scan) == 40
    np.testing.assert_allclose(scan.points @ NORMAL + 0.0118, 0.0, atol=1e-12)
    np.testing.assert_allclose(transform(truth.pose(stamp), scan.points)[:, 2], 0.0, atol=2e-6)
    np.testing.assert_allclose(CAMERA.project(scan.points), scan.pixels, atol=1e-4)
    np.testing.assert_array_equal(scan.pixels[:, 0], pixels[:, 0])


def test_the_stripe_is_where_surface_and_plane_cross_nearest_and_nowhere_on_an_edge() -> None:
    offsets = np.array([-1.0, 0.0, 1.0, 2.0])
    plane = np.ones((3, 4))
    surface = np.array([[1.01, 1.003, 0.99, 1.01], [1.2, 1.1, 0.9, 0.8], [1.02, 1.03, np.nan, 1.04]])
    np.testing.assert_allclose(stripe_offsets(surface, plane, offsets), [3 / 13, np.nan, np.nan])


def test_true_tracks_follow_the_surface_point_of_their_first_observation(truth: Truth) -> None:
    rng = np.random.default_rng(1)
    replaced, ids, first = TrueTracks(truth), np.arange(1, 31), rng.uniform(-0.2, 0.2, (30, 2))
    begun = replaced(tracks(START_NS, ids, first, TrackFlag.NEW))
    np.testing.assert_allclose(begun.rays, first, atol=1e-6)
    later_ns = START_NS + 60 * FRAME_NS
    wrong = tracks(later_ns, ids[5:], rng.uniform(-0.2, 0.2, (25, 2)), TrackFlag.TEMPLATE)
    later = replaced(wrong)
    points = truth.points(START_NS, first[5:])
    np.testing.assert_allclose(points[:, 2], 0.0, atol=1e-6)
    expected = transform(inverse(truth.pose(later_ns)), points)
    np.testing.assert_allclose(later.rays, expected[:, :2] / expected[:, 2:], atol=1e-9)
    np.testing.assert_allclose(later.pixels, CAMERA.project(expected), atol=1e-6)
    assert not later.flags.any()
    np.testing.assert_array_equal(later.sigma_px, wrong.sigma_px)


def test_tracks_that_begin_beside_the_surface_are_left_out(truth: Truth) -> None:
    found = TrueTracks(truth)(tracks(START_NS, np.array([1, 2]), np.array([[0.0, 0.0], [40.0, 0.0]]), TrackFlag.NEW))
    assert found.ids.tolist() == [1]
    assert len(found.pixels) == len(found.flags) == len(found.stripe_px) == 1


def test_an_ideal_imu_measures_rate_and_specific_force_of_the_motion(truth: Truth) -> None:
    stamps = START_NS + np.arange(200, 4500, 5) * 1_000_000
    found = TrueMotion(truth).imu(stamps)
    h = 1e-4
    for stamp, row in zip(stamps[::50].tolist(), found[::50], strict=True):
        t = (stamp - START_NS) * 1e-9
        before, now, after = (camera_pose(t + d) @ T_CAM_IMU for d in (-h, 0.0, h))
        skewed = now[:3, :3].T @ (after[:3, :3] - before[:3, :3]) / (2 * h)
        rate = np.array([skewed[2, 1], skewed[0, 2], skewed[1, 0]])
        acceleration = (before[:3, 3] - 2 * now[:3, 3] + after[:3, 3]) / h**2
        np.testing.assert_allclose(row[:3], rate, atol=2e-3)
        np.testing.assert_allclose(row[3:], now[:3, :3].T @ (acceleration + np.array([0.0, 0.0, 9.81])), atol=5e-3)


def test_without_bias_the_noise_stays_and_an_ideal_imu_has_neither(truth: Truth) -> None:
    stamps = START_NS + np.arange(0, 4900, 5) * 1_000_000
    true_motion, rng = TrueMotion(truth), np.random.default_rng(2)
    noise = 0.01 * rng.normal(size=(len(stamps), 6))
    bias = np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.3])
    measured = true_motion.imu(stamps) + bias + noise
    samples = [ImuSample(int(stamp), row[:3], row[3:]) for stamp, row in zip(stamps, measured, strict=True)]

    def errors(what: Injection) -> np.ndarray:
        found = ImuTruth.of(samples, true_motion, what).played(what)
        assert [sample.stamp_ns for sample in found] == stamps.tolist()
        return np.array([np.concatenate([s.gyro, s.accel]) for s in found]) - true_motion.imu(stamps)

    np.testing.assert_allclose(errors(Injection.IMU), 0.0, atol=1e-12)
    np.testing.assert_allclose(errors(Injection.BIAS).mean(axis=0), 0.0, atol=2e-3)
    assert errors(Injection.BIAS).std() == pytest.approx(0.01, rel=0.05)
    ends = bias_of(bias + noise, 0.005)[[0, -1]]
    np.testing.assert_allclose(ends, np.tile(bias, (2, 1)), atol=3e-3)
    assert ImuTruth.of(samples, true_motion, Injection.START).played(Injection.START) is samples


def test_the_true_state_has_pose_velocity_and_the_bias_that_is_left_in_the_samples(truth: Truth) -> None:
    stamps = START_NS + np.arange(0, 4900, 5) * 1_000_000
    true_motion, bias = TrueMotion(truth), np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.3])
    samples = [ImuSample(int(s), row[:3], row[3:]) for s, row in zip(stamps, true_motion.imu(stamps) + bias, strict=True)]
    now_ns, h = START_NS + 60 * FRAME_NS, 1e-5
    t = 60 * FRAME_NS * 1e-9
    state = ImuTruth.of(samples, true_motion, Injection.START).state(now_ns)
    np.testing.assert_allclose(state.T_map_imu, camera_pose(t) @ T_CAM_IMU, atol=1e-6)
    before, after = (camera_pose(t + d) @ T_CAM_IMU for d in (-h, h))
    np.testing.assert_allclose(state.velocity, (after - before)[:3, 3] / (2 * h), atol=1e-4)
    np.testing.assert_allclose(np.concatenate([state.gyro_bias, state.accel_bias]), bias, atol=1e-9)
    without = ImuTruth.of(samples, true_motion, Injection.START | Injection.BIAS).state(now_ns)
    assert not np.concatenate([without.gyro_bias, without.accel_bias]).any()
