"""The light on board, estimated from a chart that it lights unevenly, and taken out of the colours."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from mapping_scenes import CAMERA_HEIGHT, FRAME_NS, calibration, window
from scipy.spatial import KDTree

from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, pose, so3_exp, transform
from vli_common.types import FrameKind, Image, LaserScan, PointCloud
from vli_mapping.config import AS_SEEN, COMPENSATED
from vli_mapping.light import LightEstimator, Sightings
from vli_mapping.mapper import Mapper

CAMERA = calibration().camera
LED = np.array([-0.006, -0.005, -0.004])
AMBIENT, VIGNETTING = 0.05, 0.25
GREY_OF_WHITE = 180.0
NOTHING = np.zeros((480, 640, 3), np.uint8)
RAYS = np.column_stack([CAMERA.unproject(np.indices((480, 640))[::-1].reshape(2, -1).T.astype(float)), np.ones(480 * 640)])


def albedo(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return (N, 3) RGB of a chart on z = 0: soft patches a few mm wide."""
    wave = np.sin(700 * x) * np.cos(600 * y)
    return np.clip(np.stack([0.5 + 0.25 * wave, 0.45 - 0.2 * wave, 0.4 + 0.1 * np.sin(400 * x)], axis=1), 0.1, 1.0)


def photograph(T_map_camera: FloatArray, rng: np.random.Generator) -> np.ndarray:
    """Return the chart under the LED, BGR."""
    rays = RAYS @ T_map_camera[:3, :3].T
    points = RAYS * (-T_map_camera[2, 3] / rays[:, 2])[:, None]
    at = transform(T_map_camera, points)
    normal = T_map_camera[2, :3]
    to_light = LED - points
    r = np.linalg.norm(to_light, axis=1)
    direct = np.maximum(to_light @ normal / r, 0) * (-to_light[:, 2] / r) * (CAMERA_HEIGHT / r) ** 2
    light = (direct + AMBIENT) * (1 - VIGNETTING * (RAYS[:, 0] ** 2 + RAYS[:, 1] ** 2))
    rgb = GREY_OF_WHITE * albedo(at[:, 0], at[:, 1]) * light[:, None] + rng.normal(size=(len(at), 3))
    return np.clip(np.rint(rgb[:, ::-1]), 0, 255).astype(np.uint8).reshape(480, 640, 3)


@dataclass(frozen=True)
class Passes:
    """One mapper that saw two passes over the chart, and one for each."""

    both: Mapper
    each: tuple[Mapper, Mapper]


def pass_over_chart(mappers: tuple[Mapper, ...], first: int, height: float, tilt: float) -> None:
    """Move 20 mm over the chart at a height, metres, and tilt about x, rad, from frame ``first`` on."""
    rng = np.random.default_rng(3)
    down = pose(np.diag([1.0, -1.0, -1.0]) @ so3_exp(np.array([tilt, 0.0, 0.0])), np.zeros(3))
    stamps, kinds, poses = [], [], []
    for index in range(81):
        T = down.copy()
        T[:3, 3] = 0.00006 * index - 0.002, 0.00025 * index - height * np.tan(tilt), height
        stamps.append((first + index) * FRAME_NS)
        poses.append(T)
        kinds.append(FrameKind.SHORT if index % 2 else FrameKind.KEYFRAME if index % 16 == 0 else FrameKind.LONG)
        image, scan = Image(stamps[-1], photograph(T, rng) if index % 2 == 0 else NOTHING), chart_scan(stamps[-1], T)
        for mapper in mappers:
            mapper.add_scan(scan) if index % 2 else mapper.add_image(image)
    for mapper in mappers:
        mapper.add_window(window(stamps[:-1], kinds[:-1], poses[:-1], final=False))
        mapper.add_window(window(stamps, kinds, poses))


def chart_scan(stamp_ns: int, T_map_camera: FloatArray) -> LaserScan:
    """Return a stripe along x on the chart."""
    x = np.arange(-0.008, 0.008, 1e-4)
    y = np.full_like(x, T_map_camera[1, 3] + T_map_camera[2, 3] * 0.07)
    local = transform(inverse(T_map_camera), np.stack([x, y, np.zeros_like(x)], axis=1))
    return LaserScan(stamp_ns, local, local[:, :2], np.full(len(x), 100.0), np.full(len(x), 3e-5))


@pytest.fixture(scope="module")
def passes() -> Passes:
    both, low, high = (Mapper(calibration()) for _ in range(3))
    pass_over_chart((both, low), 0, CAMERA_HEIGHT, 0.0)
    pass_over_chart((both, high), 100, 1.25 * CAMERA_HEIGHT, 0.25)
    return Passes(both, (low, high))


def truth_of(cloud: PointCloud) -> FloatArray:
    return 255 * albedo(cloud.points[:, 0].astype(float), cloud.points[:, 1].astype(float))


def error_to_albedo(cloud: PointCloud) -> float:
    """Return the RMS of colour to albedo, of 255, after the best gain of each channel."""
    truth, colours = truth_of(cloud), cloud.colours.astype(float)
    gain = (colours * truth).sum(axis=0) / (colours**2).sum(axis=0)
    return float(np.sqrt(((gain * colours - truth) ** 2).mean()))


def difference(first: PointCloud, second: PointCloud) -> float:
    """Return the RMS between the colours of one spot in two clouds, of 255."""
    distance, nearest = KDTree(first.points).query(second.points)
    near = distance < 1.5e-4
    assert near.sum() > 1000
    return float(np.sqrt(((first.colours[nearest[near]].astype(float) - second.colours[near]) ** 2).mean()))


def test_a_flat_chart_gets_its_albedo_but_for_one_gain_a_channel(passes: Passes) -> None:
    for mapper in (passes.both, *passes.each):
        assert error_to_albedo(mapper.cloud()) < 8
    assert error_to_albedo(passes.both.cloud()) < 0.5 * error_to_albedo(passes.both.map.cloud())


def test_one_spot_has_one_colour_in_two_passes(passes: Passes) -> None:
    low, high = (mapper.map for mapper in passes.each)
    light = passes.both.light()
    assert difference(low.cloud(light=light), high.cloud(light=light)) < 5
    assert difference(low.cloud(), high.cloud()) > 20


def test_light_and_lens_are_found_where_they_are(passes: Passes) -> None:
    light = passes.both.light()
    assert light is not None
    np.testing.assert_allclose(light.position[:2], LED[:2], atol=2e-3)
    corner = np.array([[0.8 * CAMERA_HEIGHT, 0.0, CAMERA_HEIGHT]])
    assert light.vignette(corner)[0] == pytest.approx(1 - VIGNETTING * 0.64, abs=0.05)


def test_as_seen_leaves_the_light_and_takes_the_vignetting_out(passes: Passes) -> None:
    mapper = passes.each[0]
    mapper.config = replace(mapper.config, colour=AS_SEEN)
    cloud = mapper.cloud()
    mapper.config = replace(mapper.config, colour=COMPENSATED)
    view = mapper.map.views[mapper.map.columns.seen_by[mapper.map.alive()]]
    in_camera = np.einsum("nji,nj->ni", view[:, :, :3], cloud.points - view[:, :, 3])
    to_light = LED - in_camera
    r = np.linalg.norm(to_light, axis=1)
    light = (to_light[:, 2] / r) ** 2 * (CAMERA_HEIGHT / r) ** 2 + AMBIENT
    expected = GREY_OF_WHITE / 255 * truth_of(cloud) * light[:, None]
    assert np.sqrt(((cloud.colours - expected) ** 2).mean()) < 5


def test_without_spots_there_is_no_light_and_colours_stay_as_they_are() -> None:
    estimator = LightEstimator()
    empty = Sightings(np.empty(0, np.int64), np.empty(0), np.empty((0, 3)), np.empty((0, 3)))
    estimator.add(empty)
    assert estimator.fit() is None


def test_the_number_of_spots_is_bounded_and_their_fit_repeatable() -> None:
    rng = np.random.default_rng(0)

    def lots() -> LightEstimator:
        estimator = LightEstimator()
        for _ in range(200):
            points = np.repeat(rng_lot.uniform([-0.01, -0.01, 0.03], [0.01, 0.01, 0.04], (50, 3)), 2, axis=0)
            level = rng_lot.uniform(50, 60, 100)
            if not estimator.is_due():
                continue
            estimator.add(Sightings(np.repeat(np.arange(50), 2), level, points, np.tile([0.0, 0.0, -1.0], (100, 1))))
        return estimator

    rng_lot = np.random.default_rng(rng.integers(1 << 30))
    first = lots()
    rng_lot = np.random.default_rng(np.random.default_rng(0).integers(1 << 30))
    second = lots()
    assert first.spots <= 3000
    one, two = first.fit(), second.fit()
    assert one is not None
    assert two is not None
    np.testing.assert_array_equal(one.position, two.position)


def test_spots_that_come_while_a_fit_is_under_way_are_in_the_next() -> None:
    rng = np.random.default_rng(2)

    def lot() -> Sightings:
        points = np.repeat(rng.uniform([-0.01, -0.01, 0.03], [0.01, 0.01, 0.04], (250, 3)), 2, axis=0)
        return Sightings(np.repeat(np.arange(250), 2), rng.uniform(50, 60, 500), points, np.tile([0.0, 0.0, -1.0], (500, 1)))

    estimator, alone = LightEstimator(), LightEstimator()
    first = lot()
    estimator.add(first)
    alone.add(first)
    under_way = estimator.pending()
    estimator.add(lot())
    assert estimator.latest is None
    found, expected = under_way(), alone.fit()
    assert found is not None
    assert expected is not None
    np.testing.assert_array_equal(found.position, expected.position)
    assert estimator.latest is found
    later = estimator.fit()
    assert later is not None
    assert later is not found
    assert estimator.pending()() is later
