"""The front end on a plane under a light that travels with the camera, against exact truth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from planar_scene import CAMERA, LONG_NS, START_NS, T_CAM_IMU, PlanarScene, calibration

from vli_common.arrays import FloatArray
from vli_common.errors import CalibrationError
from vli_common.geometry import so3_log
from vli_common.types import FrontEndOutput, Image, ImuBias, ImuSample, LaserScan, Mode, PoseEstimate, TrackFlag
from vli_frontend.config import FrontEndConfig, KltConfig, TimeShiftConfig
from vli_frontend.frontend import FrontEnd

Items = list[Image | ImuSample]
CONFIG = FrontEndConfig(max_features=60)
FRAMES = 24


def feed(front_end: FrontEnd, items: Items) -> list[FrontEndOutput]:
    outputs = []
    for item in items:
        outputs += front_end.add_image(item) if isinstance(item, Image) else front_end.add_imu(item)
    return outputs


def make(mode: Mode = Mode.VLI_SLAM, config: FrontEndConfig = CONFIG) -> FrontEnd:
    return FrontEnd(calibration(), config, mode)


@pytest.fixture(scope="module")
def scene() -> PlanarScene:
    return PlanarScene()


@pytest.fixture(scope="module")
def items(scene: PlanarScene) -> Items:
    return list(scene.items(FRAMES))


@pytest.fixture(scope="module")
def outputs(items: Items) -> list[FrontEndOutput]:
    return feed(make(), items)


def track_errors(outputs: list[FrontEndOutput], scene: PlanarScene, age: int) -> tuple[FloatArray, FloatArray]:
    """Return true displacement and error (N, 2) of all tracks ``age`` frames after their first observation."""
    moved, errors = [], []
    for first, later in zip(outputs, outputs[age:], strict=False):
        new = (first.tracks.flags & TrackFlag.NEW) > 0
        _, a, b = np.intersect1d(first.tracks.ids[new], later.tracks.ids, return_indices=True)
        start = first.tracks.pixels[new][a]
        truth = scene.pixels(later.tracks.stamp_ns, scene.points(first.tracks.stamp_ns, CAMERA.unproject(start)))
        moved.append(truth - start)
        errors.append(later.tracks.pixels[b] - truth)
    return np.concatenate(moved), np.concatenate(errors)


def test_every_frame_comes_out_once_and_in_order(outputs: list[FrontEndOutput]) -> None:
    assert [o.tracks.stamp_ns for o in outputs] == [START_NS + k * LONG_NS for k in range(FRAMES)]


def test_tracks_do_not_lag_behind_under_a_light_that_travels_with_the_camera(
    outputs: list[FrontEndOutput], scene: PlanarScene
) -> None:
    moved, errors = track_errors(outputs, scene, 10)
    assert len(errors) > 50
    lag = (moved * errors).sum() / (moved**2).sum()
    assert abs(lag) < 5e-4
    assert np.sqrt(((errors - lag * moved) ** 2).mean()) < 0.1


def test_lucas_kanade_alone_drifts_more(items: Items, scene: PlanarScene, outputs: list[FrontEndOutput]) -> None:
    plain = replace(CONFIG, klt=KltConfig(alignment=False, normalisation_px=1))
    _, drifting = track_errors(feed(make(config=plain), items), scene, 10)
    _, aligned = track_errors(outputs, scene, 10)
    assert np.sqrt((drifting**2).mean()) > 3 * np.sqrt((aligned**2).mean())


def test_sigma_is_that_of_the_errors_at_any_age(outputs: list[FrontEndOutput], scene: PlanarScene) -> None:
    for age in (1, 5, 10):
        ratios = []
        for first, later in zip(outputs, outputs[age:], strict=False):
            new = (first.tracks.flags & TrackFlag.NEW) > 0
            _, a, b = np.intersect1d(first.tracks.ids[new], later.tracks.ids, return_indices=True)
            points = scene.points(first.tracks.stamp_ns, CAMERA.unproject(first.tracks.pixels[new][a]))
            error = later.tracks.pixels[b] - scene.pixels(later.tracks.stamp_ns, points)
            ratios.append(error / later.tracks.sigma_px[b, None])
        # Without sensor noise the sigma may well be too large, but never too small.
        assert 0.1 < np.sqrt((np.concatenate(ratios) ** 2).mean()) < 1.2


def test_sigma_has_a_floor_that_grows_with_age(outputs: list[FrontEndOutput]) -> None:
    born = {}
    for k, output in enumerate(outputs):
        for i, flags, sigma in zip(output.tracks.ids, output.tracks.flags, output.tracks.sigma_px, strict=True):
            if flags & (TrackFlag.NEW | TrackFlag.TEMPLATE):
                born[i] = k
            assert sigma >= np.hypot(CONFIG.sigma_px, CONFIG.sigma_growth_px * (k - born[i])) - 1e-12
            assert np.isfinite(sigma)


def test_ids_are_never_reused_and_each_begins_on_a_keyframe(outputs: list[FrontEndOutput]) -> None:
    alive: set[int] = set()
    ended: set[int] = set()
    for output in outputs:
        tracks = output.tracks
        now = set(tracks.ids.tolist())
        new = set(tracks.ids[(tracks.flags & TrackFlag.NEW) > 0].tolist())
        assert len(now) == len(tracks) <= CONFIG.max_features
        assert now - alive == new
        assert not now & ended
        assert not new or tracks.keyframe
        ended |= alive - now
        alive = now
    assert ended


def test_the_number_of_tracks_is_kept_up(outputs: list[FrontEndOutput]) -> None:
    assert min(len(o.tracks) for o in outputs) > 0.6 * CONFIG.max_features
    assert all(len(o.tracks) > 0.9 * CONFIG.max_features for o in outputs if o.tracks.keyframe)


def test_rays_and_velocities_are_those_of_the_pixels(outputs: list[FrontEndOutput]) -> None:
    before, now = outputs[4].tracks, outputs[5].tracks
    np.testing.assert_allclose(now.rays, CAMERA.unproject(now.pixels), atol=1e-9)
    _, a, b = np.intersect1d(before.ids, now.ids, return_indices=True)
    np.testing.assert_allclose(now.velocity[b], (now.rays[b] - before.rays[a]) / (LONG_NS * 1e-9), atol=1e-9)


def test_keyframes_come_by_parallax_and_the_preintegration_starts_at_the_last_one(
    outputs: list[FrontEndOutput], scene: PlanarScene
) -> None:
    keyframe_ns = None
    for output in outputs:
        found, stamp_ns = output.preintegration, output.tracks.stamp_ns
        if keyframe_ns is None:
            assert found is None
            assert output.tracks.keyframe
        else:
            assert found is not None
            assert (found.from_ns, found.stamp_ns) == (keyframe_ns, stamp_ns)
            pim: Any = found.measurements
            begin, end = scene.camera(keyframe_ns) @ T_CAM_IMU, scene.camera(stamp_ns) @ T_CAM_IMU
            assert np.linalg.norm(so3_log((begin[:3, :3].T @ end[:3, :3]).T @ pim.deltaRij().matrix())) < 1e-3
        keyframe_ns = stamp_ns if output.tracks.keyframe else keyframe_ns
    assert 3 <= sum(o.tracks.keyframe for o in outputs) <= FRAMES / 2


def test_rest_is_recognised_and_left_again() -> None:
    outputs = feed(make(), list(PlanarScene(rest_s=0.5).items(30)))
    at_rest = [o.tracks.stationary for o in outputs]
    assert all(at_rest[:15])
    assert not any(at_rest[22:])
    assert sum(o.tracks.keyframe for o in outputs[:15]) == 1


def test_a_gyro_bias_once_known_is_taken_out_of_the_prediction() -> None:
    bias = np.array([0.5, -0.4, 0.6])
    front_end = make()
    front_end.set_bias(ImuBias(0, bias, np.zeros(3)))
    outputs = feed(front_end, list(PlanarScene(rest_s=0.5, gyro_bias=bias).items(10)))
    assert all(o.tracks.stationary for o in outputs)
    assert not any(o.tracks.stationary for o in feed(make(), list(PlanarScene(rest_s=0.5, gyro_bias=bias).items(10))))


@pytest.fixture(scope="module")
def longer(scene: PlanarScene) -> Items:
    return list(scene.items(2 * FRAMES))


def live_pose(scene: PlanarScene, stamp_ns: int, session: int = 0) -> PoseEstimate:
    T = scene.camera(stamp_ns) @ T_CAM_IMU
    return PoseEstimate(stamp_ns, T, np.eye(4), np.zeros(3), np.zeros(3), np.eye(6), session)


def run_with_poses(items: Items, scene: PlanarScene, timeshift_ns: int, session: int = 0) -> FrontEnd:
    shift = TimeShiftConfig(memory_s=4.0)
    front_end = FrontEnd(calibration(timeshift_ns), replace(CONFIG, time_shift=shift), Mode.VLI_SLAM)
    for item in items:
        for output in feed(front_end, [item])[: item.stamp_ns > START_NS + 3 * LONG_NS]:
            # The scene starts with a jerk, which no IMU sees at 200 Hz.
            front_end.add_pose(live_pose(scene, output.tracks.stamp_ns, session))
    return front_end


def test_poses_tell_a_wrong_time_shift_which_is_corrected_and_said(longer: Items, scene: PlanarScene) -> None:
    front_end = run_with_poses(longer, scene, 8_000_000)
    assert abs(front_end.timeshift_ns) < 1_500_000
    assert "set cam0.timeshift_cam_imu to" in front_end.hint
    assert front_end.counters["time_shift_corrections"] >= 1


def test_a_right_time_shift_stays_and_nothing_is_said(longer: Items, scene: PlanarScene) -> None:
    front_end = run_with_poses(longer, scene, 0)
    assert front_end.timeshift_ns == 0
    assert front_end.hint == ""


def test_poses_of_another_session_tell_nothing(items: Items, scene: PlanarScene) -> None:
    assert run_with_poses(items, scene, 8_000_000, session=4).timeshift_ns == 8_000_000


def test_two_runs_are_identical_also_after_a_reset(items: Items, outputs: list[FrontEndOutput]) -> None:
    front_end = make()
    feed(front_end, items[: len(items) // 2])
    front_end.reset(0)
    for first, second in zip(outputs, feed(front_end, items), strict=True):
        np.testing.assert_array_equal(first.tracks.ids, second.tracks.ids)
        np.testing.assert_array_equal(first.tracks.pixels, second.tracks.pixels)
        np.testing.assert_array_equal(first.tracks.flags, second.tracks.flags)


def test_frames_prepared_ahead_are_followed_as_those_prepared_on_arrival(items: Items, outputs: list[FrontEndOutput]) -> None:
    front_end = make()
    prepared = {item.stamp_ns: front_end.prepare(item) for item in items if isinstance(item, Image)}
    found: list[FrontEndOutput] = []
    for item in items:
        if isinstance(item, Image):
            found += front_end.add_image(item, prepared[item.stamp_ns])
        else:
            found += front_end.add_imu(item)
    assert len(found) == len(outputs)
    for ahead, arrived in zip(found, outputs, strict=True):
        np.testing.assert_array_equal(ahead.tracks.pixels, arrived.tracks.pixels)


def test_imu_samples_that_are_stale_or_come_twice_change_nothing_but_a_counter(
    items: Items, outputs: list[FrontEndOutput]
) -> None:
    disturbed: Items = []
    for k, item in enumerate(items):
        disturbed.append(item)
        if isinstance(item, ImuSample) and k % 7 == 0:
            disturbed += [item, replace(item, stamp_ns=item.stamp_ns - 150_000_000)]
    front_end = make()
    found = feed(front_end, disturbed)
    np.testing.assert_array_equal(found[-1].tracks.pixels, outputs[-1].tracks.pixels)
    assert front_end.counters["imu_duplicate"] > 0
    assert front_end.counters["imu_too_late"] > 0


def test_without_imu_frames_come_out_at_once_with_tracks_and_no_preintegration(items: Items, scene: PlanarScene) -> None:
    front_end = make(Mode.VL)
    images = [item for item in items if isinstance(item, Image)]
    found = [front_end.add_image(image) for image in images]
    assert [len(outputs) for outputs in found] == [1] * FRAMES
    outputs = [output for group in found for output in group]
    assert all(output.preintegration is None for output in outputs)
    _, errors = track_errors(outputs, scene, 10)
    assert np.sqrt((errors**2).mean()) < 0.15
    assert front_end.add_imu(ImuSample(START_NS, np.zeros(3), np.zeros(3))) == []


def test_features_on_the_laser_are_told_by_their_distance_to_the_stripe(items: Items) -> None:
    stripe = np.column_stack([np.arange(320.0), np.full(320, 120.0)])
    scan = LaserScan(START_NS - LONG_NS // 2, np.ones((320, 3)), stripe, np.ones(320), np.ones(320))
    laser, other = make(), make(Mode.VI)
    for front_end in (laser, other):
        front_end.add_scan(scan)
    first = feed(laser, items[:20])[0].tracks
    np.testing.assert_allclose(first.stripe_px, np.abs(first.pixels[:, 1] - 120), atol=0.6)
    assert np.isinf(feed(other, items[:20])[0].tracks.stripe_px).all()


def test_a_doubled_brightness_loses_few_tracks(items: Items) -> None:
    dim = [
        replace(i, pixels=i.pixels // 2) if isinstance(i, Image) and i.stamp_ns < START_NS + 2.5 * LONG_NS else i for i in items
    ]
    outputs = feed(make(), dim)
    kept = np.isin(outputs[2].tracks.ids, outputs[3].tracks.ids).mean()
    assert kept >= 0.8


def test_a_covered_lens_gives_frames_without_tracks_and_tracking_comes_back(items: Items) -> None:
    def covered(item: Image | ImuSample) -> bool:
        return isinstance(item, Image) and START_NS + 4 * LONG_NS < item.stamp_ns < START_NS + 12 * LONG_NS

    dark = [replace(item, pixels=np.zeros_like(item.pixels)) if covered(item) else item for item in items]  # type: ignore[type-var]
    outputs = feed(make(), dark)
    assert len(outputs) == FRAMES
    assert len(outputs[8].tracks) == 0
    assert len(outputs[-1].tracks) > 30
    assert all(np.isfinite(o.tracks.rays).all() for o in outputs)


def test_what_belongs_to_another_session_or_sensor_is_dropped_and_counted(items: Items) -> None:
    front_end = make()
    front_end.reset(4)
    assert front_end.add_image(Image(START_NS, np.zeros((240, 320), np.uint8), session=3)) == []
    assert front_end.add_image(Image(START_NS, np.zeros((10, 10), np.uint8), session=4)) == []
    front_end.add_scan(LaserScan.empty(START_NS, session=3))
    front_end.set_bias(ImuBias(0, np.ones(3), np.ones(3), session=3))
    assert front_end.counters.values == {
        "frames_of_other_session": 1,
        "frames_of_wrong_size": 1,
        "scans_of_other_session": 1,
        "biases_ignored": 1,
    }
    outputs = feed(front_end, [replace(i, session=4) if isinstance(i, Image) else i for i in items[:30]])
    assert outputs[0].tracks.session == 4
    assert outputs[0].tracks.ids[0] == 1


def test_a_mode_with_imu_needs_its_calibration() -> None:
    bare = replace(calibration(), imu=None)
    with pytest.raises(CalibrationError, match="needs imu0"):
        FrontEnd(bare, CONFIG, Mode.VLI_ODOM)
    FrontEnd(bare, CONFIG, Mode.VL)
