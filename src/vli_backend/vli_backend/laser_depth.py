"""Features-on-laser: the depth of a feature from the registered stripe points near its viewing ray, for eq. (2).

Points of a plane have an inverse depth that is affine in the pixel, 1/z = a + b·(x − x₀, y − y₀): a weighted least-squares fit of
the stripe points near the feature gives 1/z on its ray. The stripes of one keyframe are nearly parallel lines; across them the
slope is held by a weak prior (surfaces tilted less than about 60°), which turns distance from the stripe into variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

from vli_backend.config import BackEndConfig
from vli_backend.landmarks import LandmarkTable
from vli_backend.window import Window
from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, transform
from vli_common.types import LaserScan

_REFERENCE_M = 0.03
"""Distance at which ``depth_sigma`` holds; a triangulated depth's error grows with z²."""

_SLOPE_PRIOR = 1.5
"""One sigma of the plane's slope d(1/z)/dx, in units of 1/z: the tangent of its tilt."""


@dataclass(frozen=True)
class LaserDepths:
    """Inverse depth (N,) 1/m, its sigma (N,), distance (N,) to the nearest stripe point in px; NaN, NaN, inf where none."""

    inverse_depth: FloatArray
    sigma: FloatArray
    stripe_px: FloatArray


@numba.njit(cache=True, nogil=True)
def _fit(features, rays, inverse, weight, radius, min_points, max_rms, out):  # type: ignore[no-untyped-def]
    order = np.argsort(rays[:, 0])
    sorted_x = rays[order, 0]
    h, g = np.empty((3, 3)), np.empty(3)
    for i in range(len(features)):
        fx, fy = features[i, 0], features[i, 1]
        lo, hi = np.searchsorted(sorted_x, fx - radius), np.searchsorted(sorted_x, fx + radius)
        h[:] = 0.0
        g[:] = 0.0
        count, nearest, total, mean = 0, radius * radius, 0.0, 0.0
        for k in range(lo, hi):
            m = order[k]
            dx, dy = rays[m, 0] - fx, rays[m, 1] - fy
            squared = dx * dx + dy * dy
            if squared > radius * radius:
                continue
            count += 1
            nearest = min(nearest, squared)
            w = weight[m]
            total += w
            mean += w * inverse[m]
            row = (1.0, dx, dy)
            for a in range(3):
                g[a] += w * row[a] * inverse[m]
                for b in range(3):
                    h[a, b] += w * row[a] * row[b]
        if count < min_points:
            continue
        mean /= total
        slope = 1.0 / (_SLOPE_PRIOR * mean) ** 2
        h[1, 1] += slope
        h[2, 2] += slope
        covariance = np.linalg.inv(h)
        s = covariance @ g
        squares = 0.0
        for k in range(lo, hi):
            m = order[k]
            dx, dy = rays[m, 0] - fx, rays[m, 1] - fy
            if dx * dx + dy * dy <= radius * radius:
                error = inverse[m] - s[0] - s[1] * dx - s[2] * dy
                squares += error * error
        # Inverse depth to metres: dz = z² d(1/z).
        rms = np.sqrt(squares / count) / (s[0] * s[0])
        if s[0] <= 0.0 or rms > max_rms:
            continue
        out[i, 0] = s[0]
        out[i, 1] = np.sqrt(covariance[0, 0])
        out[i, 2] = np.sqrt(nearest)


def laser_depths(
    features: FloatArray,
    points: FloatArray,
    sigma: FloatArray,
    focal_px: float,
    radius_px: float,
    min_points: int,
    max_rms: float,
) -> LaserDepths:
    """Return the laser depth of features (N, 2) rays from stripe points (M, 3) registered in the same camera frame.

    Args:
        features: (N, 2) rays.
        points: (M, 3) metres.
        sigma: (M,) metres, along the ray.
        focal_px: for pixels ⇄ rays.
        radius_px: points this near to the feature take part.
        min_points: fewer give no depth.
        max_rms: metres; rougher planes give no depth.
    """
    out = np.full((len(features), 3), np.nan)
    out[:, 2] = np.inf
    if len(points):
        z = points[:, 2]
        rays = points[:, :2] / z[:, None]
        _fit(features, rays, 1.0 / z, (z * z / sigma) ** 2, radius_px / focal_px, min_points, max_rms, out)
    return LaserDepths(out[:, 0], out[:, 1], out[:, 2] * focal_px)


def measure_keyframes(
    table: LandmarkTable,
    window: Window,
    poses: FloatArray,
    first: int,
    waiting: Sequence[LaserScan],
    focal_px: float,
    config: BackEndConfig,
) -> None:
    """Give the features of the keyframes from slot ``first`` on the laser depths that the stripes around them tell.

    Args:
        table: of the landmarks; written.
        window: of the keyframes and the scans between them.
        poses: (K, 4, 4) of the keyframes.
        first: slot.
        waiting: scans since the newest keyframe. They serve where it is the only one: the nearest counts as taken there, if that
            was at rest, or near in time.
        focal_px: for pixels ⇄ rays.
        config: parameters.
    """
    near_ns = round(config.depth_window_s * 1e9)
    for slot in range(max(0, first), len(window)):
        stripes = window.near_scans(slot, poses, near_ns)
        if len(window) == 1 and waiting:
            away_ns, nearest = min(((abs(scan.stamp_ns - window.stamps[0]), scan) for scan in waiting), key=lambda item: item[0])
            if window.stationary[0] or away_ns <= near_ns:
                stripes = [(poses[0], nearest)]
        if stripes:
            measure_slot(table, slot, poses[slot], stripes, focal_px, config)


def measure_slot(
    table: LandmarkTable,
    slot: int,
    T_map_camera: FloatArray,
    stripes: list[tuple[FloatArray, LaserScan]],
    focal_px: float,
    config: BackEndConfig,
) -> None:
    """Store the laser depths of the landmarks that the keyframe in ``slot`` saw.

    Args:
        table: of the landmarks; written.
        slot: of the keyframe.
        T_map_camera: (4, 4) of the keyframe.
        stripes: pose (4, 4) and scan of the short frames around it.
        focal_px: for pixels ⇄ rays.
        config: parameters.
    """
    back = inverse(T_map_camera)
    points = np.concatenate([transform(back @ pose, scan.points) for pose, scan in stripes])
    sigma = np.concatenate([scan.sigma for _, scan in stripes])
    rows = np.flatnonzero(table.arrays.seen[:, slot])
    rays = table.arrays.rays[rows, slot]
    found = laser_depths(rays, points, sigma, focal_px, config.depth_radius_px, config.depth_min_points, config.depth_max_rms)
    good = np.isfinite(found.inverse_depth)
    # A constant error in pixels is one constant in inverse depth: σ(1/z) = σ_z / z², with σ_z ∝ z².
    sigma_inverse = np.hypot(found.sigma[good], config.depth_sigma / _REFERENCE_M**2)
    table.set_depths(slot, rows[good], found.inverse_depth[good], sigma_inverse, found.stripe_px[good], config.primary_only)
