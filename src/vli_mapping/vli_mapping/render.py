"""A picture of a cloud without a display: point splats with a depth buffer, eye-dome lighting, three views on one sheet.

Each point is a disc wider than the points are apart; the discs that lie in front at a pixel are blended, so that surfaces close
and are smooth, and edges stay sharp (after Botsch et al., "High-quality surface splatting on today's GPUs", 2005). Shading is by
the change of depth around a pixel (eye-dome lighting: Boucheny, "Visualisation scientifique de grands volumes de données", 2009)
and gently by the normal; colours are those of the map.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numba import njit

from vli_common.arrays import BoolArray, ByteArray, Float32Array, FloatArray
from vli_common.errors import OutputError
from vli_common.types import PointCloud

SHEET = 1920, 1200
"""Width and height of the picture, pixels."""
_SUPERSAMPLE = 2
_MARGIN = 24
_TITLE = 34
_BACKGROUND_TOP, _BACKGROUND_BOTTOM = np.array([46.0, 40.0, 37.0]), np.array([24.0, 21.0, 19.0])
"""BGR."""
_TEXT = (225, 225, 225)
_FAINT = (150, 150, 150)
_MAX_POINTS = 3_000_000
_MIN_SPLAT, _MAX_SPLAT = 0.8, 24.0
_EDL_STRENGTH = 1.2
_EDL_RADII = 1, 2, 4
_TARGET_BRIGHTNESS = 0.85
"""Of the 90th percentile of brightness: a scan under on-board light is dark."""


@dataclass(frozen=True, slots=True)
class View:
    """An orthographic view: rows of ``axes`` (3, 3) are right, up and towards the viewer; ``centre`` (3,) is in the middle."""

    title: str
    axes: FloatArray
    centre: FloatArray
    metres_per_pixel: float


def write_views(path: Path, cloud: PointCloud) -> None:
    """Write the sheet of three views as PNG: from above, oblique, and close up.

    Raises:
        OutputError: the file cannot be written.
    """
    done, data = cv2.imencode(".png", draw_views(cloud))
    try:
        if not done:
            raise OSError(0, "the picture could not be encoded")
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise OutputError(f"'{path}' cannot be written: {error.strerror}") from error


def draw_views(cloud: PointCloud, size: tuple[int, int] = SHEET, caption: str = "") -> ByteArray:
    """Return the sheet (H, W, 3) BGR of a cloud; a cloud without points gives a sheet that says so.

    Args:
        cloud: points, with or without normals.
        size: width and height, pixels.
        caption: in the corner; the number of points where it is empty.
    """
    width, height = size
    sheet = _background(width, height)
    if len(cloud) == 0:
        _text(sheet, "no map points", (_MARGIN, height // 2), 1.0, _TEXT)
        return sheet
    count, cloud = len(cloud), _thinned(cloud)
    points = cloud.points.astype(np.float64)
    spacing = point_spacing(points)
    colours, normals = _exposed(cloud.colours), _normals(cloud)
    frame = principal_axes(points, normals)
    for (x, y, w, h), view in zip(_panels(width, height), _views(points, frame, spacing, width, height), strict=True):
        panel = sheet[y : y + h, x : x + w]
        panel[:] = draw(points, colours, normals, view, spacing, panel)
        _label(sheet[y - _TITLE : y, x : x + w], view)
    _text(sheet, caption or f"{count:,} points".replace(",", " "), (_MARGIN, height - 14), 0.5, _FAINT)
    return sheet


def draw(
    points: FloatArray, colours: Float32Array, normals: Float32Array, view: View, spacing: float, background: ByteArray
) -> ByteArray:
    """Return an orthographic picture (H, W, 3) BGR of points over a background of that size.

    Args:
        points: (N, 3), metres.
        colours: (N, 3), BGR, 0 … 1.
        normals: (N, 3), unit, 0 where none.
        view: where from.
        spacing: between neighbouring points, metres.
        background: (H, W, 3) BGR.
    """
    height, width = background.shape[0] * _SUPERSAMPLE, background.shape[1] * _SUPERSAMPLE
    pixel = view.metres_per_pixel / _SUPERSAMPLE
    local = (points - view.centre) @ view.axes.T / pixel
    splat = float(np.clip(spacing / pixel, _MIN_SPLAT, _MAX_SPLAT))
    lit = _lit(colours, normals, view)
    depth, blend = np.full((height, width), -np.inf, np.float32), np.zeros((height, width, 5), np.float32)
    _front(local, splat, depth)
    _blend(local, splat, max(2 * spacing / pixel, 2.0), depth, lit, blend)
    seen = blend[..., 4] > 0
    mean = (blend[..., :4] / np.where(seen, blend[..., 4], 1.0)[..., None]).astype(np.float32)
    canvas = mean[..., :3] * _eye_dome(mean[..., 3], seen, splat)[..., None]
    big = cv2.resize(background, (width, height), interpolation=cv2.INTER_LINEAR).astype(np.float32) / 255
    canvas = np.where(seen[..., None], canvas, big)
    small = cv2.resize(canvas, (background.shape[1], background.shape[0]), interpolation=cv2.INTER_AREA)
    result: ByteArray = np.clip(small * 255 + 0.5, 0, 255).astype(np.uint8)
    return result


def point_spacing(points: FloatArray) -> float:
    """Return the typical distance between neighbouring points, metres: the 75th percentile to the fourth nearest of a sample."""
    from scipy.spatial import KDTree

    if len(points) < 6:
        return 1e-3
    sample = points[np.linspace(0, len(points) - 1, min(len(points), 4000)).astype(np.int64)]
    distance: FloatArray = np.asarray(KDTree(points).query(sample, k=5)[0])
    return max(float(np.percentile(distance[:, 4], 75)), 1e-6)


def principal_axes(points: FloatArray, normals: Float32Array) -> FloatArray:
    """Return (3, 3), rows: the long side of a scan, the short one, and the side it was seen from."""
    centred = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    long, up = axes[:, 2], axes[:, 0]
    mean_normal = normals.sum(axis=0, dtype=np.float64)
    if mean_normal @ up < 0 or (not mean_normal.any() and up[2] < 0):
        up = -up
    if long[np.argmax(np.abs(long))] < 0:
        long = -long
    return np.stack([long, np.cross(up, long), up])


def _panels(width: int, height: int) -> list[tuple[int, int, int, int]]:
    """Return x, y, width, height of the panels, each under a strip for its title: two at the left, a tall one at the right."""
    left = (width - 3 * _MARGIN) * 11 // 20
    right = width - 3 * _MARGIN - left
    upper = (height - 2 * _MARGIN - 2 * _TITLE) * 11 // 20
    lower = height - 2 * _MARGIN - 2 * _TITLE - upper
    return [
        (_MARGIN, _MARGIN + _TITLE, left, upper),
        (_MARGIN, _MARGIN + 2 * _TITLE + upper, left, lower),
        (2 * _MARGIN + left, _MARGIN + _TITLE, right, height - 2 * _MARGIN - _TITLE),
    ]


def _views(points: FloatArray, frame: FloatArray, spacing: float, width: int, height: int) -> list[View]:
    panels = _panels(width, height)
    oblique, close = _turned(frame, 18.0, 44.0), _turned(frame, -32.0, 46.0)
    focus = _busiest(points, frame)
    near = points[np.linalg.norm((points - focus) @ frame[:2].T, axis=1) < _close_radius(points, frame)]
    return [
        _fit("oblique", points, oblique, panels[0]),
        _fit("from above", points, frame, panels[1]),
        _fit("close up", near if len(near) else points, close, panels[2], fill=1.25),
    ]


def _turned(frame: FloatArray, azimuth_deg: float, elevation_deg: float) -> FloatArray:
    """Return the axes of a view turned about the up axis of ``frame`` and tilted down to ``elevation_deg``."""
    azimuth, tilt = np.radians(azimuth_deg), np.radians(90 - elevation_deg)
    right = np.cos(azimuth) * frame[0] + np.sin(azimuth) * frame[1]
    ahead = -np.sin(azimuth) * frame[0] + np.cos(azimuth) * frame[1]
    towards = np.cos(tilt) * frame[2] - np.sin(tilt) * ahead
    return np.stack([right, np.cross(towards, right), towards])


def _fit(title: str, points: FloatArray, axes: FloatArray, panel: tuple[int, int, int, int], fill: float = 0.94) -> View:
    """Return the view that shows all but the outermost few points of a panel."""
    local = points @ axes.T
    low, high = np.percentile(local, [0.1, 99.9], axis=0)
    _, _, width, height = panel
    room = np.array([width, height]) * fill
    scale = float(max(((high - low)[:2] / room).max(), 1e-9))
    return View(title, axes, (low + high) / 2 @ axes, scale)


def _close_radius(points: FloatArray, frame: FloatArray) -> float:
    extent = np.ptp(points @ frame[:2].T, axis=0)
    return float(0.32 * extent.min())


def _busiest(points: FloatArray, frame: FloatArray) -> FloatArray:
    """Return the middle of the place with most relief that is well inside the scan."""
    local = points @ frame.T
    low, high = np.percentile(local[:, :2], [15, 85], axis=0)
    inside = ((local[:, :2] >= low) & (local[:, :2] <= high)).all(axis=1)
    if not inside.any():
        inside[:] = True
    cells = np.floor((local[:, :2] - low) / np.maximum((high - low) / 4, 1e-9)).astype(np.int64).clip(0, 3)
    number = cells[:, 0] * 4 + cells[:, 1]
    relief = [float(local[inside & (number == k), 2].std()) if (inside & (number == k)).sum() > 50 else 0.0 for k in range(16)]
    chosen = inside & (number == int(np.argmax(relief)))
    middle: FloatArray = points[chosen if chosen.any() else inside].mean(axis=0)
    return middle


def _thinned(cloud: PointCloud) -> PointCloud:
    if len(cloud) <= _MAX_POINTS:
        return cloud
    which = np.linspace(0, len(cloud) - 1, _MAX_POINTS).astype(np.int64)
    normals = None if cloud.normals is None else cloud.normals[which]
    return PointCloud(cloud.stamp_ns, cloud.points[which], cloud.colours[which], normals)


def _normals(cloud: PointCloud) -> Float32Array:
    return np.zeros((len(cloud), 3), np.float32) if cloud.normals is None else cloud.normals


def _exposed(colours: ByteArray) -> Float32Array:
    """Return BGR (N, 3), 0 … 1, brightened by one gain and a soft shoulder."""
    linear = colours[:, ::-1].astype(np.float32) / 255
    bright = float(np.percentile(linear.max(axis=1), 90))
    gain = np.clip(_TARGET_BRIGHTNESS / max(bright, 1e-3), 1.0, 4.0)
    result: Float32Array = np.minimum(linear * np.float32(gain), 1.0)
    return result


def _lit(colours: Float32Array, normals: Float32Array, view: View) -> Float32Array:
    """Return colours (N, 3), a little darker where the surface turns away from a lamp above the viewer's left shoulder."""
    lamp = np.array([-0.35, 0.45, 1.0])
    light = (lamp / np.linalg.norm(lamp)) @ view.axes
    facing = np.where(normals.any(axis=1), 0.5 + 0.5 * (normals @ light), 0.85)
    result: Float32Array = colours * (0.5 + 0.5 * facing)[:, None].astype(np.float32)
    return result


def _eye_dome(depth: Float32Array, seen: BoolArray, splat: float) -> Float32Array:
    """Return the factor (H, W) that darkens pixels that lie behind their surroundings."""
    total = np.zeros(depth.shape, np.float32)
    filled = np.where(seen, depth, -1e9).astype(np.float32)
    for radius in _EDL_RADII:
        step = max(round(radius * splat), 1)
        for dx, dy in ((step, 0), (-step, 0), (0, step), (0, -step)):
            moved = np.roll(filled, (dy, dx), axis=(0, 1))
            ahead = np.where(moved > -1e8, moved - filled, 0.0)
            total += np.clip(ahead / (step * 2.0), 0.0, 2.0) / (4 * len(_EDL_RADII))
    result: Float32Array = np.exp(-_EDL_STRENGTH * total).astype(np.float32)
    return result


def _background(width: int, height: int) -> ByteArray:
    share = np.linspace(0, 1, height)[:, None, None]
    rows = _BACKGROUND_TOP * (1 - share) + _BACKGROUND_BOTTOM * share
    return np.broadcast_to(rows, (height, width, 3)).round().astype(np.uint8)


def _label(strip: ByteArray, view: View) -> None:
    """Write the title, and a scale bar of a round length."""
    _text(strip, view.title, (4, 22), 0.6, _TEXT)
    room = 0.22 * strip.shape[1] * view.metres_per_pixel
    power = 10.0 ** np.floor(np.log10(room))
    length = max(step * power for step in (1, 2, 5) if step * power <= room)
    pixels = round(length / view.metres_per_pixel)
    right, base = strip.shape[1] - 8, 26
    cv2.line(strip, (right - pixels, base), (right, base), _TEXT, 2, cv2.LINE_AA)
    for x in (right - pixels, right):
        cv2.line(strip, (x, base - 5), (x, base + 5), _TEXT, 2, cv2.LINE_AA)
    _text(strip, f"{1e3 * length:g} mm", (right - pixels, 16), 0.5, _TEXT)


def _text(image: ByteArray, text: str, at: tuple[int, int], size: float, colour: tuple[int, int, int]) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


@njit(cache=True, nogil=True)
def _front(local, radius, depth):  # type: ignore[no-untyped-def]
    """Write the nearest depth at each pixel of discs at local (N, 3): in pixels from the middle, z to the viewer."""
    height, width = depth.shape
    reach = int(np.ceil(radius))
    for number in range(len(local)):
        x, y, z = local[number, 0] + width / 2, height / 2 - local[number, 1], local[number, 2]
        column, row = int(np.floor(x)), int(np.floor(y))
        for v in range(max(row - reach, 0), min(row + reach + 1, height)):
            for u in range(max(column - reach, 0), min(column + reach + 1, width)):
                inside = (u + 0.5 - x) ** 2 + (v + 0.5 - y) ** 2 <= radius * radius
                if (inside or (u == column and v == row)) and z > depth[v, u]:
                    depth[v, u] = z


@njit(cache=True, nogil=True)
def _blend(local, radius, thickness, depth, colours, blend):  # type: ignore[no-untyped-def]
    """Add colour, depth and weight (H, W, 5) of the discs within ``thickness`` of the front, heavier towards their middle."""
    height, width = depth.shape
    reach = int(np.ceil(radius))
    for number in range(len(local)):
        x, y, z = local[number, 0] + width / 2, height / 2 - local[number, 1], local[number, 2]
        column, row = int(np.floor(x)), int(np.floor(y))
        for v in range(max(row - reach, 0), min(row + reach + 1, height)):
            for u in range(max(column - reach, 0), min(column + reach + 1, width)):
                squared = ((u + 0.5 - x) ** 2 + (v + 0.5 - y) ** 2) / (radius * radius)
                if z < depth[v, u] - thickness or (squared > 1 and not (u == column and v == row)):
                    continue
                weight = np.exp(-7.0 * squared)
                for channel in range(3):
                    blend[v, u, channel] += weight * colours[number, channel]
                blend[v, u, 3] += weight * z
                blend[v, u, 4] += weight
