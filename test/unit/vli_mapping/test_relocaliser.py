from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mapping_scenes import CAMERA_HEIGHT
from printed_plate import CAMERA, Plate, apart, labelled_print, repeating_print, turned, unique_print

from vli_common.arrays import ByteArray, FloatArray
from vli_common.geometry import inverse, pose, so3_exp, transform
from vli_common.types import Counters
from vli_mapping.colour import colour_points
from vli_mapping.map_keyframes import KeyframeIntake
from vli_mapping.point_map import PointMap
from vli_mapping.relocaliser import Place, Relocaliser, View
from vli_mapping.scan_window import PosedScan

PATH = [(0.045 + 0.003 * k, 0.035 + 0.002 * k) for k in range(4)]
T_MAP_SESSION = pose(so3_exp(np.array([0.0, 0.0, 1.1])), np.array([0.2, -0.1, 0.03]))


@pytest.fixture(scope="module")
def unique() -> tuple[Plate, PointMap]:
    plate = Plate(unique_print())
    return plate, plate.point_map()


def seek(
    plate: Plate,
    point_map: PointMap,
    T_map_session: FloatArray = T_MAP_SESSION,
    is_levelled: bool = True,
    path: list[tuple[float, float]] = PATH,
) -> tuple[Place | None, Counters]:
    """Go along a path over a plate, as a session that does not know where it is; return what it finds in a map."""
    counters = Counters()
    relocaliser = Relocaliser(point_map, point_map.keyframes, CAMERA, is_levelled, counters)
    scans: list[PosedScan] = []
    place = None
    for index, (x, y) in enumerate(path):
        view = turned(x, y, 0.5)
        pixels = plate.image(view, index).pixels
        for step in range(10):
            T = turned(x + 3e-4 * step, y + 2e-4 * step, 0.5)
            scans.append(posed(plate, T, inverse(T_map_session) @ T, 10 * index + step, (pixels, view)))
        relocaliser.add_view(View(index, pixels, inverse(T_map_session) @ view))
        place = place or relocaliser.locate(scans)
    return place, counters


def posed(
    plate: Plate, T_map_camera: FloatArray, T_session_camera: FloatArray, number: int, view: tuple[ByteArray, FloatArray]
) -> PosedScan:
    """Return a scan with its pose in the session, and colours of an image that was taken where the map has it."""
    scan = plate.scan(T_map_camera, number)
    count = len(scan)
    colours = colour_points(CAMERA, transform(T_map_camera, scan.points), [view])
    normals = np.tile(T_session_camera[:3, :3].T @ [0, 0, 1], (count, 1)).astype(np.float32)
    every = np.ones(count, np.bool_)
    return PosedScan(scan, number, T_session_camera, colours, every, every, normals, np.ones(count, np.float32), described=True)


def test_a_session_is_found_wherever_it_lies_in_the_map(unique: tuple[Plate, PointMap]) -> None:
    place, _ = seek(*unique)
    assert place is not None
    where = np.array([*PATH[0], 0.0])
    session = inverse(T_MAP_SESSION)
    assert apart(place.T_map_session @ session, np.eye(4), where) < 1e-3
    assert place.sigma_m < 2e-4
    assert place.agreeing > 0.8
    assert place.likeness > 0.5


def test_a_print_that_repeats_exactly_gives_no_answer() -> None:
    plate = Plate(repeating_print())
    place, counters = seek(plate, plate.point_map())
    assert place is None
    assert counters["relocalisation_ambiguous"] == len(PATH)


def test_equal_fields_are_told_apart_by_what_is_printed_on_them() -> None:
    plate = Plate(labelled_print())
    place, _ = seek(plate, plate.point_map())
    assert place is not None
    assert apart(place.T_map_session @ inverse(T_MAP_SESSION), np.eye(4), np.array([*PATH[0], 0.0])) < 1e-3


def test_a_part_that_is_not_in_the_map_is_not_taken_for_one_that_looks_similar() -> None:
    """The map has fields like those that are scanned, but none of the very ones."""
    mapped, other = labelled_print(), labelled_print()
    other[:, :] = repeating_print()
    place, counters = seek(Plate(other), Plate(mapped).point_map())
    assert place is None
    assert counters["relocalisation_views"] == len(PATH)


def test_a_place_nobody_has_seen_gives_no_answer(unique: tuple[Plate, PointMap]) -> None:
    place, counters = seek(Plate(unique_print(seed=9)), unique[1])
    assert place is None
    assert counters["relocalisation_nothing_alike"] + counters["relocalisation_few_features"] == len(PATH)


def test_an_answer_that_tilts_gravity_is_none(unique: tuple[Plate, PointMap]) -> None:
    tilted = T_MAP_SESSION @ pose(so3_exp(np.array([0.2, 0.0, 0.0])), np.zeros(3))
    assert seek(*unique, T_map_session=tilted)[0] is None
    assert seek(*unique, T_map_session=tilted, is_levelled=False)[0] is not None


def test_stripes_that_do_not_lie_on_the_map_speak_against_an_answer(unique: tuple[Plate, PointMap]) -> None:
    """The picture is right, but what the laser sees is no plate."""
    plate, point_map = unique
    counters = Counters()
    relocaliser = Relocaliser(point_map, point_map.keyframes, CAMERA, True, counters)
    scans, view = [], turned(0.05, 0.04, 0.5)
    pixels = plate.image(view).pixels
    for step in range(20):
        T = turned(0.05 + 3e-4 * step, 0.04, 0.5)
        item = posed(plate, T, T, step, (pixels, view))
        bumps = 1.0 + 0.02 * np.sin(item.scan.points[:, :1] / 5e-4)
        scans.append(replace(item, scan=replace(item.scan, points=item.scan.points * bumps)))
    relocaliser.add_view(View(0, pixels, view))
    assert relocaliser.locate(scans) is None
    assert counters["relocalisation_stripes_disagree"] == 1


def test_views_of_the_map_know_where_their_features_are(unique: tuple[Plate, PointMap]) -> None:
    _, point_map = unique
    assert len(point_map.keyframes) > 20
    for keyframe in point_map.keyframes:
        assert len(keyframe) >= 25
        assert np.abs(keyframe.points[:, 2]).max() < 5e-5
        assert keyframe.depth == CAMERA_HEIGHT


def test_what_is_seen_again_from_the_same_place_is_not_remembered_twice(unique: tuple[Plate, PointMap]) -> None:
    plate, point_map = unique
    before = len(point_map.keyframes)
    intake = KeyframeIntake(CAMERA)
    for offset, angle in ((1e-3, 0.0), (-2e-3, 0.0)):
        T = turned(0.05 + offset, 0.04, angle)
        intake.offer(plate.image(T), T, CAMERA_HEIGHT, point_map)
    intake.learn(point_map, None)
    assert len(point_map.keyframes) == before
