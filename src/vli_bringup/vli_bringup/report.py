"""The figures of an evaluation as text and as JSON: Tables I and II of the paper, its values beside ours.

The paper's values: Cheng et al., "Visual-Laser-Inertial SLAM Using a Compact 3D Scanner for Confined Space", ICRA 2021:
hand-held, 185.4 cm in six passes over a keyboard at some 3 cm.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from vli_bringup.consistency import ConsistencyFigures
from vli_bringup.map_metrics import CompletenessFigures, SurfaceFigures
from vli_bringup.trajectory_metrics import TrajectoryFigures

Value = float | int | None
_HUGE = 1e5


@dataclass(frozen=True, slots=True)
class RunFigures:
    """Figures of the run as a whole; the field names are the keys of the JSON report.

    Args:
        poses_share_percent: share of the truth's long frames with a live pose, from ``poses_share_from_s`` on.
        poses_share_from_s: seconds after the first stamp of the truth.
        points: points of the map; None without a map.
        ms_per_frame_mean, ms_per_frame_p95, realtime_factor: as ``summary.json`` of the run has them.
    """

    poses_share_percent: float | None
    poses_share_from_s: float
    points: int | None
    ms_per_frame_mean: float | None = None
    ms_per_frame_p95: float | None = None
    realtime_factor: float | None = None


@dataclass(frozen=True, slots=True)
class Evaluation:
    """All figures of one run; None where the input for them was not there."""

    run: RunFigures
    live: TrajectoryFigures
    final: TrajectoryFigures | None
    surface: SurfaceFigures | None
    completeness: CompletenessFigures | None
    consistency: ConsistencyFigures


def as_dict(evaluation: Evaluation) -> dict[str, Value]:
    """Return the figures flat: live ones under their name, those of ``trajectory_final.tum`` with the prefix ``final_``.

    The keys are always the same; a figure that could not be computed is None.
    """
    out: dict[str, Value] = dataclasses.asdict(evaluation.live)
    out |= {f"final_{key}": value for key, value in _fields(TrajectoryFigures, evaluation.final).items()}
    out |= _fields(SurfaceFigures, evaluation.surface)
    out |= _fields(CompletenessFigures, evaluation.completeness)
    out |= dataclasses.asdict(evaluation.consistency)
    out |= dataclasses.asdict(evaluation.run)
    return out


def _fields(kind: type, figures: SurfaceFigures | CompletenessFigures | TrajectoryFigures | None) -> dict[str, Value]:
    if figures is None:
        return {field.name: None for field in dataclasses.fields(kind)}
    return dataclasses.asdict(figures)


def as_text(evaluation: Evaluation) -> str:
    """Return Tables I and II and the figures the paper does not have, as markdown that reads well on a terminal."""
    figures = as_dict(evaluation)
    return "\n\n".join([_table_1(evaluation), _table_2(figures), _further(figures)]) + "\n"


def _table_1(evaluation: Evaluation) -> str:
    live, final = evaluation.live, evaluation.final

    def row(name: str, paper: Sequence[str], value: Callable[[TrajectoryFigures], str]) -> list[str]:
        return [name, *paper, value(live), value(final) if final else "–"]

    rows = [
        row("translation RMSE / max, mm", ("51 / 86", "3.9 / 8.6", "3.2 / 6.0"),
            lambda f: f"{_text(f.translation_rmse_mm, '.3f')} / {_text(f.translation_max_mm, '.3f')}"),
        row("translation drift, %", ("4.6", "0.46", "0.32"), lambda f: _text(f.drift_percent, ".3f")),
        row("absolute, per pass, %", ("23.7", "0.65", "–"), lambda f: _text(f.absolute_drift_percent, ".3f")),
        row("rotation RMSE / max, rad", (".022 / .030", ".014 / .033", ".023 / .035"),
            lambda f: f"{f.rotation_rmse_rad:.4f} / {f.rotation_max_rad:.4f}"),
        row("rotation drift, 1e-4 rad/cm", ("1.6", "1.8", "1.9"), lambda f: _text(f.rotation_drift_rad_per_m, ".2f", 100)),
        row("absolute, 1e-4 rad/cm", ("4.3", "3.1", "–"), lambda f: _text(f.absolute_rotation_drift_rad_per_m, ".2f", 100)),
        row("scale error, %", ("–", "–", "–"), lambda f: _text(f.scale_error_percent, "+.3f")),
        row("path length, cm", ("185.4", "185.4", "185.4"), lambda f: _text(f.path_length_m, ".1f", 100)),
    ]  # fmt: skip
    header = ["trajectory", "VINS-Mono (paper)", "VLI-Odom (paper)", "VLI-SLAM (paper)", "live", "final"]
    return "Table I\n\n" + _table(header, rows)


def _table_2(figures: Mapping[str, Value]) -> str:
    rows = [
        ["point-to-point RMSE, mm", "2.3", "1.2", "0.97", _text(figures["map_point_to_point_rmse_mm"], ".3f")],
        ["point-to-plane RMSE, mm", "2.0", "0.93", "0.76", _text(figures["map_point_to_plane_rmse_mm"], ".3f")],
    ]
    header = ["map", "D435 + RTAB-Map (paper)", "VLI-Odom (paper)", "VLI-SLAM (paper)", "this run"]
    return "Table II\n\n" + _table(header, rows)


def _further(figures: Mapping[str, Value]) -> str:
    def row(name: str, form: str, *keys: str, factor: float = 1) -> list[str]:
        return [name, " / ".join(_text(figures[key], form, factor) for key in keys)]

    rows = [
        row(f"long frames with a pose, from {figures['poses_share_from_s']:g} s on, %", ".2f", "poses_share_percent"),
        row("tilt of map against truth, live / final, mrad", ".2f", "tilt_rad", "final_tilt_rad", factor=1e3),
        row("NEES of the position (3: consistent)", ".2f", "position_nees"),
        row("sigma of the last position, mm", ".3f", "position_sigma_mm"),
        row("map points", ",.0f", "points"),
        row("point-to-plane median, mm", ".3f", "map_point_to_plane_median_mm"),
        row("map points beyond 0.5 / 1 mm, %", ".2f", "beyond_0_5mm_percent", "beyond_1mm_percent"),
        row("completeness within 0.5 mm, %", ".2f", "completeness_percent"),
        row("colour RMSE / gain compensated, %", ".2f", "colour_rmse", "colour_rmse_gain_compensated", factor=100),
        row("time per long frame, mean / p95, ms (paper: 29.8)", ".1f", "ms_per_frame_mean", "ms_per_frame_p95"),
        row("real-time factor", ".2f", "realtime_factor"),
    ]
    return "Further\n\n" + _table(["figure", "this run"], rows)


def _text(value: Value, form: str, factor: float = 1) -> str:
    if value is None:
        return "–"
    # A trajectory that flew away must not take the table apart.
    return format(value * factor, form if "," in form or abs(value * factor) < _HUGE else ".1e")


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a markdown table with padded cells: names to the left, values to the right."""
    widths = [max(len(cell) for cell in column) for column in zip(header, *rows, strict=True)]

    def line(cells: Sequence[str]) -> str:
        padded = [cells[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True))]
        return "| " + " | ".join(padded) + " |"

    rule = f"|{'-' * (widths[0] + 2)}|" + "".join("-" * (width + 1) + ":|" for width in widths[1:])
    return "\n".join([line(header), rule, *(line(row) for row in rows)])
