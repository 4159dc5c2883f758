from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mapping_scenes import FRAME_NS, SIGMA, looking_down, scan_of, step_height, stripe

from vli_common.arrays import FloatArray
from vli_common.geometry import so3_exp
from vli_common.types import NANOSECONDS, Counters, MapConstraints
from vli_mapping.association import associate
from vli_mapping.config import AssociationConfig
from vli_mapping.point_map import PointMap
from vli_mapping.scan_window import PosedScan

CONFIG = AssociationConfig(min_constraints=5)
LATE_NS = 60 * NANOSECONDS
LATE_NUMBER = 1000


@pytest.fixture(scope="module")
def stepped() -> PointMap:
    """A map of the stepped plate, 20 mm × 20 mm, of scans 0 … 65."""
    point_map = PointMap()
    rng = np.random.default_rng(0)
    x = np.arange(-0.01, 0.01, 2e-4)
    for number, y in enumerate(np.arange(0, 0.02, 3e-4)):
        points = np.stack([x, np.full_like(x, y), step_height(np.full_like(x, y))], axis=1)
        point_map.insert(stripe(points + rng.normal(size=points.shape) * 1e-5, number))
        point_map.refine_normals(point_map.alive(), np.array([0, 0, 1.0]))
    return point_map


def posed(y: float, shift: tuple[float, float, float] = (0, 0, 0), number: int = LATE_NUMBER) -> PosedScan:
    """Return a scan at ``y``, believed to be ``shift`` away from where it was taken."""
    T = looking_down(0.0, y)
    scan = scan_of(LATE_NS, T, y, half_width=8e-3)
    believed = T.copy()
    believed[:3, 3] += shift
    count = len(scan)
    return PosedScan(
        scan, number, believed, np.full((count, 3), 100, np.float32), np.ones(count, np.bool_), np.ones(count, np.bool_),
        np.zeros((count, 3), np.float32), np.zeros(count, np.float32), described=True,
    )  # fmt: skip


def found(point_map: PointMap, item: PosedScan, config: AssociationConfig = CONFIG) -> tuple[MapConstraints | None, Counters]:
    counters = Counters()
    return associate(point_map, [item], LATE_NS, config, counters, session=3), counters


def residuals(constraints: MapConstraints, item: PosedScan) -> np.ndarray:
    points = constraints.points_camera @ item.T_map_camera[:3, :3].T + item.T_map_camera[:3, 3]
    return np.einsum("ni,ni->n", constraints.points_map - points, constraints.normals_map)


def test_a_scan_where_it_belongs_has_no_residual(stepped: PointMap) -> None:
    item = posed(0.006)
    constraints, counters = found(stepped, item)
    assert constraints is not None
    assert np.abs(residuals(constraints, item)).max() < 2e-5
    assert len(constraints) == counters["constraints_matched"] >= CONFIG.points_per_scan
    assert (constraints.stamp_ns, constraints.session) == (LATE_NS, 3)
    assert set(constraints.scan_stamps.tolist()) == {LATE_NS}
    np.testing.assert_allclose(np.linalg.norm(constraints.normals_map, axis=1), 1.0, atol=1e-9)


@pytest.mark.parametrize("height", [2e-4, -2e-4])
def test_a_scan_believed_too_high_is_pulled_down_and_one_too_low_up(stepped: PointMap, height: float) -> None:
    item = posed(0.003, (0, 0, height))
    constraints, _ = found(stepped, item)
    assert constraints is not None
    assert residuals(constraints, item) * constraints.normals_map[:, 2] == pytest.approx(-height, abs=3e-5)


def test_a_scan_on_the_slope_is_pulled_along_the_normal_so_that_the_shift_is_seen(stepped: PointMap) -> None:
    shift = 1e-4
    item = posed(0.01, (0, shift, 0))
    constraints, _ = found(stepped, item)
    assert constraints is not None
    # The slope of the step in its middle is 2 mm / (4 · 0.8 mm); its normal leans towards −y by as much.
    assert np.median(residuals(constraints, item) * constraints.normals_map[:, 1]) < 0
    lean = np.abs(constraints.normals_map[:, 1])
    assert np.median(np.abs(residuals(constraints, item)) / lean) == pytest.approx(shift, rel=0.35)


def test_a_plane_does_not_constrain_what_it_cannot_see(stepped: PointMap) -> None:
    item = posed(0.003, (3e-4, 3e-4, 0))
    constraints, _ = found(stepped, item)
    assert constraints is not None
    assert np.abs(residuals(constraints, item)).max() < 3e-5


def test_what_lies_beyond_the_gate_does_not_correspond(stepped: PointMap) -> None:
    near, far = posed(0.003, (0, 0, 0.9e-3)), posed(0.003, (0, 0, 1.5e-3))
    assert found(stepped, near)[0] is not None
    constraints, counters = found(stepped, far)
    assert constraints is None
    assert counters["constraints_no_map_point"] > 0
    assert found(stepped, far, replace(CONFIG, gate=3e-3))[0] is not None


@pytest.mark.parametrize("number", [65, 94])
def test_points_of_the_last_scans_do_not_confirm_the_window(stepped: PointMap, number: int) -> None:
    # The map's scan at y = 19.5 mm is number 65.
    item = posed(0.0195, number=number)
    constraints, counters = found(stepped, item, replace(CONFIG, gate=2e-4))
    assert constraints is None
    assert counters["constraints_too_young"] > 0


def test_points_that_entered_a_moment_ago_do_not_confirm_the_window_however_many_scans_there_were(stepped: PointMap) -> None:
    item = posed(0.006)
    age = (LATE_NS - 66 * 2 * FRAME_NS) / NANOSECONDS
    assert found(stepped, item, replace(CONFIG, min_age_s=age - 1))[0] is not None
    constraints, counters = found(stepped, item, replace(CONFIG, min_age_s=LATE_NS / NANOSECONDS + 1))
    assert constraints is None
    assert counters["constraints_too_young"] > 0


def test_another_colour_does_not_correspond(stepped: PointMap) -> None:
    item = posed(0.006)
    item.colours[:, 1] = 250
    constraints, counters = found(stepped, item)
    assert constraints is None
    assert counters["constraints_colour_differs"] > 0


def test_another_normal_does_not_correspond_nor_the_far_side_of_a_thin_wall(stepped: PointMap) -> None:
    for normal in ([1, 0, 0], [0, 0, 1]):
        # In the camera frame +z is away from it: the surface is seen from behind.
        item = posed(0.003)
        item.normals[:] = normal
        constraints, counters = found(stepped, item)
        assert constraints is None
        assert counters["constraints_normal_differs"] > 0
    item = posed(0.003)
    item.normals[:] = [0, 0, -1]
    assert found(stepped, item)[0] is not None


def test_edges_weigh_less_than_surfaces_and_clutter_nothing() -> None:
    point_map = PointMap()
    x = np.arange(-0.01, 0.01, 2e-4)
    for number, y in enumerate(np.arange(0, 0.01, 2e-4)):
        # A ridge along x: two planes that meet at a right angle in the middle.
        points = np.stack([x, np.full_like(x, y), np.full_like(x, -abs(y - 0.005))], axis=1)
        point_map.insert(stripe(points, number))
    point_map.refine_normals(point_map.alive(), np.array([0, 0, 1.0]))
    weights = {}
    for y, z in ((0.002, -0.003), (0.0046, -0.0004), (0.005, 0.0)):
        item = posed(y)
        item.T_map_camera[2, 3] = z + 0.03
        constraints, _ = found(point_map, item)
        weights[y] = 0.0 if constraints is None else float(constraints.weight.mean())
    assert weights[0.002] > 0.9
    assert weights[0.005] < weights[0.0046] < weights[0.002]
    rng = np.random.default_rng(0)
    clutter = PointMap()
    clutter.insert(stripe(rng.uniform(-5e-3, 5e-3, (8000, 3)) * [1, 1, 0.4], 0))
    constraints, counters = found(clutter, posed(0.0))
    assert counters["constraints_no_plane"] > 0.8 * (counters["constraints_no_plane"] + counters["constraints_matched"])


def test_sigma_is_in_metres_and_never_below_the_floor(stepped: PointMap) -> None:
    constraints, _ = found(stepped, posed(0.003), replace(CONFIG, sigma_floor=1e-4))
    assert constraints is not None
    assert (constraints.sigma >= np.hypot(1e-4, SIGMA)).all()
    assert (constraints.sigma < 2e-4).all()


def test_too_few_correspondences_are_not_sent(stepped: PointMap) -> None:
    assert found(stepped, posed(0.003), replace(CONFIG, min_constraints=10_000))[0] is None
    assert associate(stepped, [], LATE_NS, CONFIG, Counters()) is None
    assert found(PointMap(), posed(0.003))[0] is None


def test_the_shift_of_a_whole_window_comes_out_of_its_constraints(stepped: PointMap) -> None:
    """Solve eq. (4) for one translation of all scans: the step sees y, the plates z, nothing sees x."""
    shift = np.array([0.0, 8e-5, -1.2e-4])
    items = [posed(y, tuple(shift)) for y in np.arange(0.004, 0.016, 4e-4)]  # type: ignore[arg-type]
    for item in items:
        item.scan = replace(item.scan, stamp_ns=LATE_NS + round(item.T_map_camera[1, 3] * 1e9))
    constraints = associate(stepped, items, LATE_NS, CONFIG, Counters())
    assert constraints is not None
    poses = {item.scan.stamp_ns: item.T_map_camera for item in items}
    T = np.stack([poses[stamp] for stamp in constraints.scan_stamps.tolist()])
    points = np.einsum("nij,nj->ni", T[:, :3, :3], constraints.points_camera) + T[:, :3, 3]
    residual = np.einsum("ni,ni->n", constraints.points_map - points, constraints.normals_map)
    root = np.sqrt(constraints.weight) / constraints.sigma
    solved = np.linalg.lstsq((constraints.normals_map * root[:, None])[:, 1:], residual * root, rcond=None)[0]
    np.testing.assert_allclose(solved, -shift[1:], atol=1.5e-5)


RADIUS, AXIS_HEIGHT = 0.02, -0.02


def on_bar(x: FloatArray, angle: FloatArray) -> FloatArray:
    """Return points (N, 3) of a bar along x whose top is the x axis, ``angle`` from its top."""
    return np.stack([x, RADIUS * np.sin(angle), RADIUS * np.cos(angle) + AXIS_HEIGHT], axis=1)


def turned(angle: float) -> FloatArray:
    """Return the motion (4, 4) around the axis of the bar."""
    T = np.eye(4)
    T[:3, :3] = so3_exp(np.array([angle, 0.0, 0.0]))
    T[:3, 3] = [0.0, 0.0, AXIS_HEIGHT] - T[:3, :3] @ [0.0, 0.0, AXIS_HEIGHT]
    return T


def moved(along: float) -> FloatArray:
    """Return the motion (4, 4) along the axis of the bar."""
    T = np.eye(4)
    T[0, 3] = along
    return T


def test_a_bar_constrains_neither_the_way_along_its_axis_nor_the_turn_around_it() -> None:
    bar = PointMap()
    rng = np.random.default_rng(0)
    angle = np.arange(-0.6, 0.6, 5e-3)
    for number, x in enumerate(np.arange(-0.006, 0.006, 2.5e-4)):
        points = on_bar(np.full_like(angle, x), angle)
        bar.insert(stripe(points + rng.normal(size=points.shape) * 1e-5, number))
    bar.refine_normals(bar.alive(), np.array([0, 0, 1.0]))
    points = on_bar(np.zeros(80), np.linspace(-0.4, 0.4, 80))
    local = (points - looking_down(0.0, 0.0)[:3, 3]) @ looking_down(0.0, 0.0)[:3, :3]
    free, stiff = [], []
    for believed, seen in ((moved(3e-4), free), (turned(0.015), free), (np.eye(4), free)):
        item = posed(0.003)
        item.T_map_camera = believed @ looking_down(0.0, 0.0)
        item.scan = replace(item.scan, points=local, sigma=np.full(80, SIGMA))
        for name, shape in (("colours", (80, 3)), ("normals", (80, 3)), ("planarity", 80), ("solid", 80)):
            setattr(item, name, np.full(shape, {"colours": 100, "solid": 1}.get(name, 0), getattr(item, name).dtype))
        constraints, _ = found(bar, item)
        assert constraints is not None
        seen.append(np.sqrt(np.mean(residuals(constraints, item) ** 2)))
        # Rows of the Jacobian of the point-to-plane distance by a motion of the scan, about the axis of the bar.
        arm = constraints.points_map - [0.0, 0.0, AXIS_HEIGHT]
        rows = np.concatenate([constraints.normals_map, np.cross(arm, constraints.normals_map) / RADIUS], axis=1)
        stiff.append(np.sqrt((rows**2).mean(axis=0)))
    assert max(free) < 2e-5
    for sensitivity in stiff:
        assert sensitivity[0] < 0.03
        assert sensitivity[3] < 0.03
        assert sensitivity[2] > 0.8
        assert sensitivity[1] > 0.15
