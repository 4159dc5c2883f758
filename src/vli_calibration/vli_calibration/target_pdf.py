"""A target as PDF at true scale, with a ruler to hold another one against."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from vli_calibration.targets import Target
from vli_common.arrays import FloatArray
from vli_common.errors import InputError

PAGES_MM: dict[str, tuple[float, float]] = {
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
}
"""Paper by name, upright."""

_ISO = ("a4", "a3", "a2", "a1", "a0")
_MM = 1e3
_INCH_MM = 25.4
_UNPRINTABLE_MM = 5.0
_FOOT_MM = 20.0
"""Strip below the pattern for ruler and text."""

_QUIET_MM = (4.0, 15.0)
_LONGEST_RULER_MM = 200.0
_RULER_STEP_MM = 50.0
_LABEL_STEP_MM = 10
_TICK_MM = 0.15


@dataclass(frozen=True, slots=True)
class Sheet:
    """A target laid out on paper.

    Args:
        page: name of the paper, or its size.
        size_mm: width and height as printed.
        pattern_mm: (M, 4) black rectangles x0, y0, x1, y1 from the upper left corner of the paper.
        ruler_mm: length of the ruler.
        data: the PDF.
    """

    page: str
    size_mm: tuple[float, float]
    pattern_mm: FloatArray
    ruler_mm: float
    data: bytes


def make_sheet(target: Target, page: str | None = None) -> Sheet:
    """Lay a target out on a page and return it as PDF, vectors throughout.

    Args:
        target: what to print.
        page: name in :data:`PAGES_MM`, or WIDTHxHEIGHT in millimetres; by default the smallest of A4 to A0 that holds it.

    Raises:
        InputError: the page is unknown or too small.
    """
    needed = _needed_mm(target)
    name, size = _page(page, needed, target)
    ruler = min(_LONGEST_RULER_MM, (size[0] - 4 * _UNPRINTABLE_MM) // _RULER_STEP_MM * _RULER_STEP_MM)
    x0, y0, x1, y1 = (_MM * value for value in target.extent)
    left = (size[0] - (x1 - x0)) / 2
    top = (size[1] - _FOOT_MM - _UNPRINTABLE_MM - (y1 - y0)) / 2
    pattern = _MM * target.rectangles + np.tile([left - x0, top - y0], 2)
    return Sheet(name, size, pattern, ruler, _pdf(target, pattern, size, ruler))


def _needed_mm(target: Target) -> tuple[float, float]:
    """Return width and height of pattern, quiet zone, foot and the edge that printers leave white."""
    x0, y0, x1, y1 = target.extent
    quiet = float(np.clip(_MM * target.margin / 4, *_QUIET_MM))
    around = 2 * (quiet + _UNPRINTABLE_MM)
    return _MM * (x1 - x0) + around, _MM * (y1 - y0) + around + _FOOT_MM


def _page(page: str | None, needed: tuple[float, float], target: Target) -> tuple[str, tuple[float, float]]:
    """Return name and size, turned so that the pattern fits."""
    for name in _ISO if page is None else (page,):
        for size in _both_ways(_page_size(name)):
            if needed[0] <= size[0] and needed[1] <= size[1]:
                return name.upper() if name in PAGES_MM else name, size
    wanted = f"'{page}'" if page else "A0"
    raise InputError(
        f"target '{target.spec}' needs '{needed[0]:.0f} x {needed[1]:.0f}' mm of paper, more than {wanted}; "
        "take smaller squares, or --page WIDTHxHEIGHT (mm) of your plotter"
    )


def _page_size(page: str) -> tuple[float, float]:
    if page.lower() in PAGES_MM:
        return PAGES_MM[page.lower()]
    try:
        width, height = (float(part) for part in page.lower().split("x"))
    except ValueError:
        width = height = 0.0
    if not (50 <= width <= 5000 and 50 <= height <= 5000):
        raise InputError(f"page '{page}' is unknown, expected {', '.join(PAGES_MM)} or WIDTHxHEIGHT in mm, 50 to 5000 each")
    return width, height


def _both_ways(size: tuple[float, float]) -> tuple[tuple[float, float], tuple[float, float]]:
    return size, (size[1], size[0])


def _pdf(target: Target, pattern: FloatArray, size: tuple[float, float], ruler: float) -> bytes:
    figure = Figure(figsize=(size[0] / _INCH_MM, size[1] / _INCH_MM), frameon=False)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.set(xlim=(0, size[0]), ylim=(size[1], 0))
    left, line = (size[0] - ruler) / 2, size[1] - _UNPRINTABLE_MM - 9
    # One path for all: rectangles that touch then show no seam.
    for rectangles in (pattern, _ruler(ruler) + np.tile([left, line], 2)):
        axes.add_patch(PathPatch(_outline(rectangles), facecolor="black", linewidth=0))
    for mark in range(0, int(ruler) + 1, _LABEL_STEP_MM):
        axes.text(left + mark, line - 0.8, f"{mark}", fontsize=5, ha="center", va="bottom")
    text = f"{target.spec}    print at 100 % (actual size): this ruler must measure {ruler:.0f} mm"
    axes.text(size[0] / 2, line + 7, text, fontsize=6, ha="center", va="bottom")
    stream = io.BytesIO()
    figure.savefig(stream, format="pdf", metadata={"CreationDate": None, "Title": target.spec})
    return stream.getvalue()


def _ruler(length: float) -> FloatArray:
    """Return the ticks (M, 4), one a millimetre, and the line under them, millimetres."""
    ticks = []
    for mark in range(int(length) + 1):
        height = 4.0 if mark % 10 == 0 else 3.0 if mark % 5 == 0 else 2.0
        ticks.append((mark - _TICK_MM / 2, 0.0, mark + _TICK_MM / 2, height))
    return np.array([*ticks, (-_TICK_MM / 2, -_TICK_MM, length + _TICK_MM / 2, 0.0)])


def _outline(rectangles: FloatArray) -> Outline:
    """Return one path of all rectangles (M, 4)."""
    x0, y0, x1, y1 = rectangles.T
    corners = np.stack([x0, y0, x1, y0, x1, y1, x0, y1, x0, y0], axis=1).reshape(-1, 2)
    codes = np.tile([Outline.MOVETO, Outline.LINETO, Outline.LINETO, Outline.LINETO, Outline.CLOSEPOLY], len(rectangles))
    return Outline(corners, codes)
