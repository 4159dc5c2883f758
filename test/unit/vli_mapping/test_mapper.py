from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mapping_scenes import FRAME_NS, calibration, long_image, looking_down, scan_of, step_height, window

from vli_common.types import FrameKind, LaserScan, MappingOutput, Mode, WindowPoses
from vli_mapping.config import AssociationConfig, MappingConfig
from vli_mapping.mapper import Mapper

SPEED = 4e-4
"""Metres from scan to scan."""


def pose_at(index: int) -> np.ndarray:
    return looking_down(0.0, index * SPEED / 2)


def feed(mapper: Mapper, first: int, last: int, seed: int | None = None, session: int = 0) -> tuple[list[int], list[FrameKind]]:
    """Give the mapper frames [first, last), long and short alternating; return stamps and kinds."""
    stamps, kinds = [], []
    for index in range(first, last):
        stamp = index * FRAME_NS
        if index % 2 == 0:
            mapper.add_image(replace(long_image(stamp), session=session))
            kinds.append(FrameKind.LONG)
        else:
            T = pose_at(index)
            mapper.add_scan(replace(scan_of(stamp, T, T[1, 3], seed=None if seed is None else seed + index), session=session))
            kinds.append(FrameKind.SHORT)
        stamps.append(stamp)
    return stamps, kinds


def run(mapper: Mapper, first: int, last: int, final: bool = True, redundant: bool = False, session: int = 0) -> MappingOutput:
    stamps, kinds = feed(mapper, first, last, session=session)
    return mapper.add_window(window(stamps, kinds, [pose_at(i) for i in range(first, last)], final, redundant, session))


def test_final_scans_enter_the_map_with_colour_and_normals() -> None:
    mapper = Mapper(calibration())
    output = run(mapper, 0, 41)
    cloud = mapper.map.cloud()
    assert mapper.counters["scans_entered"] == 20
    assert len(cloud) > 1000
    assert np.abs(cloud.points[:, 2] - step_height(cloud.points[:, 1].astype(float))).max() < 2e-5
    np.testing.assert_array_equal(np.unique(cloud.colours, axis=0), [[120, 80, 40]])
    assert (cloud.normals[cloud.normals.any(axis=1), 2] > 0.7).all()
    assert cloud.normals.any(axis=1).mean() > 0.9
    assert output.update is not None
    assert len(output.update) == len(cloud)


def test_scans_still_in_the_window_are_shown_but_do_not_enter() -> None:
    mapper = Mapper(calibration())
    output = run(mapper, 0, 21, final=False)
    assert len(mapper.map) == 0
    assert output.update is None
    assert output.cloud is not None
    assert len(output.cloud) == 10 * 300
    again = mapper.add_window(window([20 * FRAME_NS], [FrameKind.LONG], [pose_at(20)], final=False))
    assert again.cloud is None


def test_a_scan_enters_with_its_last_pose() -> None:
    mapper = Mapper(calibration())
    stamps, kinds = feed(mapper, 0, 21)
    wrong = [looking_down(0.0, i * SPEED / 2, 0.031) for i in range(21)]
    mapper.add_window(window(stamps, kinds, wrong, final=False))
    mapper.add_window(window(stamps, kinds, [pose_at(i) for i in range(21)]))
    cloud = mapper.map.cloud()
    assert np.abs(cloud.points[:, 2] - step_height(cloud.points[:, 1].astype(float))).max() < 2e-5


def test_redundant_scans_do_not_enter() -> None:
    mapper = Mapper(calibration())
    output = run(mapper, 0, 41, redundant=True)
    assert len(mapper.map) == 0
    assert mapper.counters["scans_redundant"] == 20
    assert output.cloud is None


def test_a_scan_enters_once_however_its_window_is_repeated() -> None:
    mapper = Mapper(calibration())
    stamps, kinds = feed(mapper, 0, 21)
    poses = window(stamps, kinds, [pose_at(i) for i in range(21)])
    mapper.add_window(poses)
    before = mapper.map.cloud()
    mapper.add_window(poses)
    assert mapper.counters["scans_entered"] == 10
    assert mapper.counters["poses_without_scan"] == 10
    np.testing.assert_array_equal(mapper.map.cloud().weights, before.weights)


def test_what_is_missing_is_counted() -> None:
    mapper = Mapper(calibration())
    stamps, kinds = feed(mapper, 0, 11)
    mapper.add_scan(LaserScan.empty(12 * FRAME_NS))
    stamps, kinds = [*stamps, 12 * FRAME_NS, 14 * FRAME_NS], [*kinds, FrameKind.SHORT, FrameKind.SHORT]
    mapper.add_window(window(stamps, kinds, [pose_at(i) for i in [*range(11), 12, 14]]))
    assert mapper.counters["scans_empty"] == 1
    assert mapper.counters["poses_without_scan"] == 1
    mapper.add_scan(scan_of(20 * FRAME_NS, pose_at(20), 0.0))
    mapper.add_scan(scan_of(20 * FRAME_NS + 11_000_000_000, pose_at(20), 0.0))
    assert mapper.counters["scans_without_pose"] == 1


def test_a_scan_without_a_long_image_enters_without_a_colour() -> None:
    mapper = Mapper(calibration())
    stamps = [i * FRAME_NS for i in range(1, 21, 2)]
    for i in range(1, 21, 2):
        mapper.add_scan(scan_of(i * FRAME_NS, pose_at(i), pose_at(i)[1, 3]))
    mapper.add_window(window(stamps, [FrameKind.SHORT] * 10, [pose_at(i) for i in range(1, 21, 2)]))
    assert mapper.counters["scans_without_image"] == 10
    assert len(mapper.map) > 500
    assert (mapper.map.cloud().colours == 128).all()


def test_a_ghost_of_one_scan_does_not_stay_where_the_surface_is_seen() -> None:
    mapper = Mapper(calibration())
    stamps, kinds = feed(mapper, 0, 41)
    ghost = scan_of(21 * FRAME_NS, pose_at(21), pose_at(21)[1, 3])
    ghost.points[100:112] *= 0.8
    mapper.add_scan(ghost)
    mapper.add_window(window(stamps, kinds, [pose_at(i) for i in range(41)]))
    cloud = mapper.map.cloud()
    high = cloud.points[:, 2] > step_height(cloud.points[:, 1].astype(float)) + 1e-3
    doubtful = ~mapper.map.columns.solid[mapper.map.alive()]
    assert doubtful[high].all()


def again(mapper: Mapper, later: int, depth: float) -> None:
    """Go over the scene, ``later`` frames after the first time, with a third of the stripe at so many times its depth."""
    stamps, kinds, poses = [], [], []
    for index in range(0, 81):
        stamp, T = (index + later) * FRAME_NS, pose_at(index)
        if index % 2:
            scan = scan_of(stamp, T, T[1, 3])
            scan.points[100:200] *= depth
            mapper.add_scan(scan)
        else:
            mapper.add_image(long_image(stamp))
        stamps.append(stamp)
        kinds.append(FrameKind.SHORT if index % 2 else FrameKind.LONG)
        poses.append(T)
    mapper.add_window(window(stamps, kinds, poses))
    mapper.settle()


def test_a_surface_that_is_no_longer_there_is_told_and_one_that_is_still_there_is_not() -> None:
    mapper = Mapper(calibration())
    for later in (0, 1000, 2000):
        again(mapper, later, 1.0)
    assert mapper.hint == ""
    again(mapper, 3000, 1.1)
    assert mapper.hint.startswith("the scene has changed: ")
    for later in (4000, 5000):
        again(mapper, later, 1.0)
    assert mapper.hint == ""
    again(mapper, 6000, 1.1)
    mapper.reset(1)
    assert mapper.hint == ""


def perturbed(first: int, last: int, height: float) -> WindowPoses:
    poses = [looking_down(0.0, i * SPEED / 2, 0.03 + height) for i in range(first, last)]
    kinds = [FrameKind.LONG if i % 2 == 0 else FrameKind.SHORT for i in range(first, last)]
    stamps = [(i + 1000) * FRAME_NS for i in range(first, last)]
    return window(stamps, kinds, poses, final=False)


@pytest.mark.parametrize(("mode", "constrains"), [(Mode.VLI_SLAM, True), (Mode.VL, True), (Mode.VLI_ODOM, False)])
def test_a_second_pass_with_drift_is_pulled_back_to_the_first(mode: Mode, constrains: bool) -> None:
    config = MappingConfig(association=AssociationConfig(min_age_scans=10, min_age_s=1.0))
    mapper = Mapper(calibration(), config, mode)
    assert run(mapper, 0, 61).constraints is None
    second = perturbed(10, 51, 1.5e-4)
    for i in range(11, 51, 2):
        scan = scan_of((i + 1000) * FRAME_NS, pose_at(i), pose_at(i)[1, 3], seed=i)
        mapper.add_scan(scan)
    output = mapper.add_window(second)
    assert (output.constraints is not None) == constrains
    if output.constraints is None:
        return
    T = second.T_map_camera[np.searchsorted(second.stamps, output.constraints.scan_stamps)]
    points = np.einsum("nij,nj->ni", T[:, :3, :3], output.constraints.points_camera) + T[:, :3, 3]
    normals = output.constraints.normals_map
    pull = ((output.constraints.points_map - points) * normals).sum(axis=1) / normals[:, 2]
    assert np.median(pull) == pytest.approx(-1.5e-4, abs=1.5e-5)
    assert output.constraints.stamp_ns == second.stamp_ns


def test_the_first_pass_does_not_constrain_itself() -> None:
    mapper = Mapper(calibration())
    for start in range(0, 120, 20):
        assert run(mapper, start, start + 20, final=start < 80).constraints is None
    assert mapper.counters["constraints_matched"] == 0


def test_constraints_can_be_switched_off_while_running() -> None:
    config = MappingConfig(association=AssociationConfig(min_age_scans=10, min_age_s=1.0))
    mapper = Mapper(calibration(), config)
    run(mapper, 0, 61)
    mapper.constrains = False
    for i in range(11, 51, 2):
        mapper.add_scan(scan_of((i + 1000) * FRAME_NS, pose_at(i), pose_at(i)[1, 3]))
    assert mapper.add_window(perturbed(10, 51, 0.0)).constraints is None


def test_a_new_session_starts_a_new_map_and_drops_what_belongs_to_the_old() -> None:
    mapper = Mapper(calibration())
    run(mapper, 0, 21)
    old = mapper.map
    held = len(old)
    mapper.add_scan(scan_of(23 * FRAME_NS, pose_at(23), pose_at(23)[1, 3]))
    run(mapper, 40, 61, session=1)
    assert len(old) == held
    assert mapper.map is not old
    assert mapper.counters["sessions"] == 1
    assert mapper.counters["scans_entered"] == 20
    assert mapper.map.cloud().points[:, 1].min() > 0.007


def test_a_late_window_of_an_old_session_changes_nothing() -> None:
    mapper = Mapper(calibration())
    run(mapper, 40, 61, session=1)
    held = mapper.map
    assert run(mapper, 0, 21, session=0) == MappingOutput()
    assert mapper.map is held
    assert mapper.counters["windows_of_old_session"] == 1
    assert mapper.counters["scans_entered"] == 10


def test_nothing_is_kept_of_what_is_done() -> None:
    mapper = Mapper(calibration())
    for start in range(0, 200, 20):
        run(mapper, start, start + 20)
    window_state = mapper._window
    assert len(window_state._images) + len(window_state._waiting) + len(window_state._scans) < 20


def test_without_a_laser_nothing_is_kept() -> None:
    mapper = Mapper(calibration(), mode=Mode.VI)
    for index in range(100):
        mapper.add_image(long_image(index * FRAME_NS))
    output = mapper.add_window(window([0], [FrameKind.KEYFRAME], [pose_at(0)]))
    assert output == MappingOutput()
    assert not mapper._window._images


def test_two_runs_give_the_same_bytes() -> None:
    clouds = []
    for _ in range(2):
        mapper = Mapper(calibration())
        run(mapper, 0, 61)
        clouds.append(mapper.map.cloud())
    assert clouds[0].points.tobytes() == clouds[1].points.tobytes()
    assert clouds[0].normals is not None
    assert clouds[1].normals is not None
    assert clouds[0].normals.tobytes() == clouds[1].normals.tobytes()


def partly_final(mapper: Mapper, first: int, last: int, final_before: int) -> None:
    """Give a window of frames [first, last) of which those before ``final_before`` leave."""
    stamps = [index * FRAME_NS for index in range(first, last)]
    kinds = [FrameKind.SHORT if index % 2 else FrameKind.LONG for index in range(first, last)]
    whole = window(stamps, kinds, [pose_at(index) for index in range(first, last)])
    mapper.add_window(replace(whole, final=np.arange(first, last) < final_before))


def test_scans_that_leave_enter_one_by_one_with_those_that_come() -> None:
    mapper = Mapper(calibration())
    feed(mapper, 0, 41)
    partly_final(mapper, 0, 41, 20)
    assert mapper.counters["scans_entered"] == 0
    feed(mapper, 41, 47)
    assert mapper.counters["scans_entered"] == 3
    partly_final(mapper, 20, 47, 20)
    assert mapper.counters["scans_entered"] == 10


def test_the_map_does_not_depend_on_when_scans_enter() -> None:
    clouds = []
    for eager in (True, False):
        mapper = Mapper(calibration())
        for first in range(0, 120, 20):
            feed(mapper, first, first + 20)
            partly_final(mapper, max(first - 20, 0), first + 20, first)
            if eager:
                mapper.settle()
        clouds.append(mapper.cloud())
    np.testing.assert_array_equal(clouds[0].points, clouds[1].points)
    np.testing.assert_array_equal(clouds[0].colours, clouds[1].colours)
    assert len(clouds[0]) > 1000
