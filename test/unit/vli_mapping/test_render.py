from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from vli_common.errors import OutputError
from vli_common.types import PointCloud
from vli_mapping.render import SHEET, View, draw, draw_views, point_spacing, principal_axes, write_views


def plate(colour: tuple[int, int, int] = (200, 40, 40), normal: tuple[float, float, float] = (0, 0, 1)) -> PointCloud:
    """Return a 40 mm × 20 mm plate of one colour (RGB)."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-0.02, 0.02, 4e-4), np.arange(-0.01, 0.01, 4e-4)))
    points = np.stack([x, y, np.zeros_like(x)], axis=1).astype(np.float32)
    count = len(points)
    return PointCloud(0, points, np.full((count, 3), colour, np.uint8), np.full((count, 3), normal, np.float32))


def picture(points: np.ndarray, colours: np.ndarray, spacing: float = 1e-3) -> np.ndarray:
    view = View("", np.eye(3), np.zeros(3), 1e-4)
    normals = np.zeros((len(points), 3), np.float32)
    return draw(points, colours.astype(np.float32), normals, view, spacing, np.zeros((100, 100, 3), np.uint8))


def test_what_is_nearer_to_the_viewer_hides_what_is_behind() -> None:
    points, colours = np.array([[0, 0, 0], [0, 0, 5e-3]]), np.array([[1.0, 0, 0], [0, 0, 1.0]])
    for order in ([0, 1], [1, 0]):
        middle = picture(points[order], colours[order])[50, 50]
        assert middle[2] > 100
        assert middle[0] == 0


def test_up_is_up_and_right_is_right() -> None:
    image = picture(np.array([[3e-3, 3e-3, 0]]), np.array([[1.0, 1.0, 1.0]]))
    rows, columns = np.nonzero(image[..., 0] > 50)
    assert rows.mean() == pytest.approx(50 - 30, abs=1)
    assert columns.mean() == pytest.approx(50 + 30, abs=1)


def test_a_plate_has_no_holes() -> None:
    cloud = plate()
    view = View("", np.eye(3), np.zeros(3), 1e-4)
    colours = cloud.colours[:, ::-1].astype(np.float32) / 255
    assert cloud.normals is not None
    spacing = point_spacing(cloud.points.astype(float))
    image = draw(cloud.points.astype(float), colours, cloud.normals, view, spacing, np.zeros((160, 360, 3), np.uint8))
    assert (image[..., 2] > 100).all()
    assert image[..., 2].std() < 3


def test_edges_are_smoothed() -> None:
    image = picture(np.zeros((1, 3)), np.ones((1, 3)))
    assert ((image[..., 0] > 5) & (image[..., 0] < 0.7 * image.max())).any()


def test_a_step_casts_a_dark_line_on_what_is_behind_it() -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-5e-3, 5e-3, 1e-4), np.arange(-5e-3, 5e-3, 1e-4)))
    points = np.stack([x, y, np.where(x > 0, 2e-3, 0)], axis=1)
    image = picture(points, np.ones((len(points), 3)), 1.5e-4).astype(float)
    assert image[50, 47, 0] < 0.85 * image[50, 20, 0]


def test_spacing_is_that_of_the_grid() -> None:
    assert point_spacing(plate().points.astype(float)) == pytest.approx(4e-4, rel=0.05)


@pytest.mark.parametrize("side", [1, -1])
def test_the_scan_is_shown_from_where_it_was_seen(side: int) -> None:
    cloud = plate(normal=(0, 0, side))
    assert cloud.normals is not None
    axes = principal_axes(cloud.points.astype(float), cloud.normals)
    np.testing.assert_allclose(axes[2], [0, 0, side], atol=1e-6)
    np.testing.assert_allclose(np.abs(axes[0]), [1, 0, 0], atol=1e-6)
    assert np.linalg.det(axes) == pytest.approx(1.0)


def test_the_sheet_shows_the_cloud_in_all_three_panels(tmp_path: Path) -> None:
    write_views(tmp_path / "cloud.png", plate())
    image = cv2.imread(str(tmp_path / "cloud.png"))
    assert image.shape == (SHEET[1], SHEET[0], 3)
    red = (image[..., 2].astype(int) - image[..., 1]) > 60
    height, width = red.shape
    for part in (red[: height // 2, : width // 2], red[height // 2 :, : width // 2], red[:, 3 * width // 5 :]):
        assert part.mean() > 0.1


def test_a_dark_scan_is_brightened_and_a_bright_one_is_left() -> None:
    dark, bright = draw_views(plate((60, 12, 12))), draw_views(plate((220, 44, 44)))
    assert np.abs(np.percentile(dark[..., 2], 90) - np.percentile(bright[..., 2], 90)) < 25


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_few_points_or_none_are_no_error(count: int) -> None:
    points = np.random.default_rng(0).uniform(0, 1e-2, (count, 3)).astype(np.float32)
    image = draw_views(PointCloud(0, points, np.full((count, 3), 200, np.uint8)))
    assert image.shape == (SHEET[1], SHEET[0], 3)


def test_a_picture_that_cannot_be_written_is_an_error_that_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        write_views(tmp_path / "absent" / "cloud.png", plate())
