"""Plots of an evaluation, as PNG files: trajectory, errors along the axes, map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vli_bringup.trajectory_metrics import rms
from vli_common.arrays import BoolArray, Float32Array, FloatArray, IntArray
from vli_common.types import NANOSECONDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from vli_bringup.evaluation import MapResult, Result
    from vli_bringup.trajectory_metrics import TrajectoryErrors

_DPI = 130
_MARGIN_MM = 5.0
_TRUTH, _LIVE, _FINAL, _MISSING = "#9a9a9a", "#c2410c", "#1d4ed8", "#dc2626"
_AXES = ("#b91c1c", "#15803d", "#1d4ed8")
_STYLE: Any = {
    "font.size": 9, "axes.titlesize": 10, "axes.titleweight": "bold", "axes.titlelocation": "left", "legend.frameon": False,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "axes.axisbelow": True, "grid.alpha": 0.25,
}  # fmt: skip


def write_plots(result: Result, directory: Path) -> None:
    """Write ``trajectory.png``, ``errors.png`` and, where there is a map to compare, ``map.png``.

    Raises:
        OSError: a file cannot be written.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with rc_context(_STYLE):
        figures = {"trajectory": _trajectory(result), "errors": _errors(result)}
        if result.map is not None and len(result.map.points) and (result.map.distances or result.map.seen is not None):
            figures["map"] = _map(result.map)
        for name, figure in figures.items():
            FigureCanvasAgg(figure).print_png(directory / f"{name}.png")


def _figure(width: float, height: float) -> Figure:
    # Not pyplot: no global state, no display.
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=_DPI, layout="constrained")


def _trajectory(result: Result) -> Figure:
    """Draw the path, coloured by its error, and the error over time."""
    live = result.live
    plane = widest_axes(live.truth)
    figure = _figure(9, 7)
    path, time = figure.subplots(2, 1, height_ratios=[1.15, 1])
    norm = 1e3 * np.linalg.norm(live.translation, axis=1)
    path.plot(*_mm(live.truth, plane), color=_TRUTH, lw=3, alpha=0.6, label="truth", solid_capstyle="round")
    dots = path.scatter(*_mm(live.positions, plane), c=norm, s=4, cmap="plasma", label="live", zorder=3)
    figure.colorbar(dots, ax=path, label="error, mm", shrink=0.9)
    _plane_axes(path, plane, "Camera path, live, aligned by SE(3)")
    path.set_adjustable("datalim")
    path.legend(loc="upper right", ncols=2)
    seconds = _seconds(live.stamps_ns, live.stamps_ns)
    _shade_passes(time, result.passes_ns, live.stamps_ns)
    rmse = result.figures.live.translation_rmse_mm
    time.plot(seconds, norm, color=_LIVE, lw=1.1, label=f"live, RMSE {rmse:.3f} mm")
    if result.final is not None and result.figures.final is not None:
        final_norm = 1e3 * np.linalg.norm(result.final.translation, axis=1)
        label = f"final, RMSE {result.figures.final.translation_rmse_mm:.3f} mm"
        time.plot(_seconds(result.final.stamps_ns, live.stamps_ns), final_norm, color=_FINAL, lw=1.1, label=label)
    time.set(
        xlabel="time since the first pose, s",
        ylabel="position error, mm",
        title="Position error",
        ylim=(0, None),
        xlim=(0, seconds[-1]),
    )
    time.legend(loc="upper right", ncols=2)
    return figure


def _errors(result: Result) -> Figure:
    """Draw the errors along the axes of the truth: translation, rotation."""
    figure = _figure(9, 6.5)
    trajectories = [("live", result.live)] + ([("final", result.final)] if result.final else [])
    grid = figure.subplots(2, len(trajectories), sharex=True, sharey="row", squeeze=False)
    for column, (name, errors) in zip(grid.T, trajectories, strict=True):
        _components(column[0], errors, 1e3 * errors.translation, result, f"Position error, {name}")
        _components(column[1], errors, 1e3 * errors.rotation, result, f"Rotation error, {name}")
        column[1].set_xlabel("time since the first pose, s")
    grid[0, 0].set_ylabel("mm")
    grid[1, 0].set_ylabel("mrad")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure


def _components(axes: Axes, errors: TrajectoryErrors, values: FloatArray, result: Result, title: str) -> None:
    _shade_passes(axes, result.passes_ns, result.live.stamps_ns)
    axes.axhline(0, color="black", lw=0.6)
    for value, name, colour in zip(values.T, "xyz", _AXES, strict=True):
        axes.plot(_seconds(errors.stamps_ns, result.live.stamps_ns), value, color=colour, lw=0.9, label=name)
    axes.set_title(title)


def _map(mapped: MapResult) -> Figure:
    """Draw the map coloured by its distance to the surface, the spread of that, and what of the seen surface is missing."""
    compared, seen = mapped.distances, mapped.seen
    plane = widest_axes(mapped.points)
    rows = (compared is not None) + (seen is not None)
    figure = _figure(10, 0.6 + 3.7 * rows)
    grid = figure.subplots(rows, 2, width_ratios=[3, 1], squeeze=False)
    grid[-1, 1].set_axis_off()
    if compared is not None:
        _heat_map(figure, grid[0, 0], mapped.points, 1e3 * compared.to_plane, plane)
        _histogram(grid[0, 1], 1e3 * compared.to_plane)
    if seen is not None and mapped.covered is not None:
        _coverage(grid[-1, 0], seen, mapped.covered, plane)
    if compared is not None and seen is not None:
        _cumulative(grid[-1, 1], 1e3 * compared.to_point)
    return figure


def _limit(error: FloatArray) -> float:
    """Return where the colours and the histogram of the error end: some outliers do not take the contrast away."""
    near = np.isfinite(error)
    return float(np.percentile(np.abs(error[near]), 99)) if near.any() else 1.0


def _heat_map(figure: Figure, axes: Axes, points: FloatArray, error: FloatArray, plane: tuple[int, int]) -> None:
    near, limit = np.isfinite(error), _limit(error)
    shown = np.flatnonzero(near)[np.argsort(points[near, 3 - sum(plane)], kind="stable")]
    if not near.all():
        axes.scatter(*_mm(points[~near], plane), s=0.8, c="black", lw=0, label="beyond 1 mm")
        axes.legend(loc="upper right", markerscale=8)
    dots = axes.scatter(*_mm(points[shown], plane), c=error[shown], s=0.8, lw=0, cmap="RdBu_r", vmin=-limit, vmax=limit)
    figure.colorbar(dots, ax=axes, label="point to plane, mm", shrink=0.85, extend="both")
    _plane_axes(axes, plane, "Map, distance to the surface")
    if near.any():  # what flew away would shrink the rest to a dot
        first, second = _mm(points[near], plane)
        axes.set_xlim(first.min() - _MARGIN_MM, first.max() + _MARGIN_MM)
        axes.set_ylim(second.min() - _MARGIN_MM, second.max() + _MARGIN_MM)


def _histogram(axes: Axes, error: FloatArray) -> None:
    near, limit = np.isfinite(error), _limit(error)
    axes.hist(error[near], bins=np.linspace(-1.5 * limit, 1.5 * limit, 81).tolist(), color="#475569")
    axes.axvline(0, color="black", lw=0.6)
    axes.set_axis_on()
    title = f"RMSE {rms(error[near]):.3f} mm" if near.any() else "nothing within 1 mm"
    axes.set(xlabel="point to plane, mm", yticks=[], title=title)
    axes.grid(visible=False)


def _cumulative(axes: Axes, distance: FloatArray) -> None:
    """Draw the share of all map points, those beyond 1 mm included, within a distance of the surface."""
    steps = np.linspace(0, 1, 201)
    axes.set_axis_on()
    axes.plot(steps, 100 * np.searchsorted(np.sort(distance), steps, side="right") / len(distance), color="#475569", lw=1.4)
    axes.set(xlabel="point to point, mm", ylabel="map points within, %", title="Map points", xlim=(0, 1), ylim=(0, 101))


def _coverage(axes: Axes, seen: FloatArray | Float32Array, covered: BoolArray, plane: tuple[int, int]) -> None:
    for which, colour, label in ((covered, "#cbd5e1", "in the map"), (~covered, _MISSING, "missing")):
        axes.scatter(*_mm(seen[which], plane), s=0.8, lw=0, c=colour, label=f"{label}: {100 * which.mean():.1f} %")
    _plane_axes(axes, plane, "What the laser saw: a map point within 0.5 mm")
    axes.legend(loc="upper right", markerscale=8, ncols=2)


def _plane_axes(axes: Axes, plane: tuple[int, int], title: str) -> None:
    axes.set(aspect="equal", xlabel=f"{'xyz'[plane[0]]}, mm", ylabel=f"{'xyz'[plane[1]]}, mm", title=title)


def _mm(points: FloatArray | Float32Array, plane: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    first, second = (1e3 * points[:, axis].astype(np.float64) for axis in plane)
    return first, second


def widest_axes(points: FloatArray) -> tuple[int, int]:
    """Return the two axes along which points (N, 3) extend most, in their order: the top view of a flat scene."""
    extent = np.ptp(np.percentile(points, [1, 99], axis=0), axis=0)
    first, second = sorted(int(axis) for axis in np.argsort(extent, kind="stable")[1:])
    return first, second


def _seconds(stamps_ns: IntArray, origin_ns: IntArray) -> FloatArray:
    result: FloatArray = (stamps_ns - origin_ns[0]) / NANOSECONDS
    return result


def _shade_passes(axes: Axes, passes_ns: IntArray, origin_ns: IntArray) -> None:
    for start, end in passes_ns[1::2]:
        axes.axvspan(*_seconds(np.array([start, end]), origin_ns), color="black", alpha=0.05, lw=0)
