"""Compile every kernel of this package, so that no frame waits for the compiler."""

from __future__ import annotations

import numpy as np

from vli_common.camera import make_camera
from vli_common.types import Counters, LaserScan
from vli_mapping.albedo import albedo
from vli_mapping.association import associate
from vli_mapping.colour import colour_points
from vli_mapping.config import AssociationConfig, EntryConfig, MapConfig
from vli_mapping.contradiction import contradict
from vli_mapping.entry import away_from_edges, facing, noisy, supported
from vli_mapping.light import Light
from vli_mapping.map_keyframes import meet
from vli_mapping.normals import smooth_normals, stripe_normals
from vli_mapping.photographs import Photograph, develop
from vli_mapping.point_map import PointMap, Stripe
from vli_mapping.scan_window import PosedScan
from vli_mapping.spatial_hash import SpatialHash
from vli_mapping.thinning import thin


def warm_up() -> None:
    """Run each compiled kernel once, with the types it meets at work; fast where the compiled code is in numba's cache."""
    limits, entry = MapConfig(), EntryConfig()
    point_map = PointMap(limits, capacity=16)
    points = np.stack([np.linspace(-0.01, 0.01, 64), np.zeros(64), np.full(64, 0.03)], axis=1)
    step, sigma = np.array([0.0, 3e-4, 0.0]), np.full(64, 3e-5)
    for number in range(6):
        row = points + number * step
        normals, planarity = stripe_normals(row, row + step, limits.normal_radius, limits.min_planarity)
        solid = away_from_edges(row, sigma, entry) & supported(row, row, entry.support_radius) & facing(row, normals, 80.0)
        solid[::3] = ~noisy(row, sigma, entry.max_blur)[::3] & (number % 2 == 0)
        stripe = Stripe(0, number, np.eye(4), row, normals, planarity, np.zeros((64, 3), np.float32), sigma, solid)
        stripe, *_ = contradict(point_map, stripe)
        point_map.refine_normals(np.unique(point_map.insert(stripe).clip(0)), np.zeros(3))
    c = point_map.columns
    SpatialHash.of(points, limits.normal_radius).reserve(1 << 12, points, np.ones(64, np.bool_))
    smooth_normals(point_map.grid, c.position, c.normal, point_map.alive(), limits.normal_radius)
    light = Light(np.zeros(3), 0.0, (0.0, 0.0), 0.03)
    albedo(point_map, light)
    scan = LaserScan(0, points, points[:, :2], sigma, sigma)
    every, normals, planarity = np.ones(64, np.bool_), np.zeros((64, 3), np.float32), np.zeros(64, np.float32)
    posed = PosedScan(scan, 1000, np.eye(4), np.zeros((64, 3), np.float32), every, every, normals, planarity)
    associate(point_map, [posed], 0, AssociationConfig(min_age_s=0.0), Counters())
    meet(point_map, np.eye(4), np.zeros((2, 2)), 0.03)
    thin(point_map.columns.position[: point_map.rows], point_map.columns.weight[: point_map.rows], 8)
    camera = make_camera("none", (100.0, 100.0, 8.0, 8.0), (), (16, 16))
    for shape in ((16, 16, 3), (16, 16)):
        pixels = np.zeros(shape, np.uint8)
        colour_points(camera, points, [(pixels, np.eye(4))])
        develop(point_map, light, camera, [Photograph.of(pixels, np.eye(4), 0.03)])
