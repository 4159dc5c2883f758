"""The map of a recording with known poses: what the mapping stage alone makes of real stripes."""

from __future__ import annotations

from pathlib import Path

from bench_map import scan_with_truth

from vli_bringup.evaluation_data import read_cloud, read_surface
from vli_bringup.map_metrics import nearest_map_points, surface_distances, surface_figures
from vli_common.calibration import load_calibration

POSE_ERROR_M = 6e-5


def test_the_map_of_a_scan_with_good_poses_is_exact_complete_and_clean(shared_data: Path) -> None:
    data = shared_data / "keyboard_short"
    mapper = scan_with_truth(data, load_calibration(data / "calibration.yaml"), POSE_ERROR_M)
    cloud = mapper.map.cloud()
    figures = surface_figures(surface_distances(cloud.points.astype(float), read_surface(data / "surface.ply")))
    covered, _ = nearest_map_points(read_cloud(data / "seen.ply").points, cloud.points)
    assert figures.map_point_to_plane_rmse_mm is not None
    assert figures.map_point_to_point_rmse_mm is not None
    assert figures.map_point_to_plane_rmse_mm < 0.09
    assert figures.map_point_to_point_rmse_mm < 0.12
    assert figures.beyond_1mm_percent < 0.1
    assert covered.mean() > 0.94
    assert len(cloud) >= 100_000
    assert cloud.normals is not None
    assert cloud.normals.any(axis=1).mean() > 0.9
    assert mapper.counters["constraints_matched"] > 10_000
    assert mapper.counters["scans_without_image"] == 0
