"""The report of ``vli calibrate laser``: tables, drawings, pictures of what was rejected, verdict, and figures for machines."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vli_calibration.laser_calibration import LaserFit, StripeResidual
from vli_calibration.laser_scenes import LaserScene
from vli_calibration.report import Report, Verdict, make_figure
from vli_common.arrays import ByteArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

IMAGE_HEADER = ("image", "points", "RMS mm", "depth mm", "left out mm")
KEY_HEADER = ("figure", "value")
_MM = 1e3
_BINS = 4
_PICTURES = 8
_GREEN, _RED = (80, 220, 60), (40, 40, 240)
_GOOD_TILT_DEG, _USABLE_TILT_DEG = 0.5, 2.0
_GOOD_SHIFT, _USABLE_SHIFT = 0.003, 0.01
"""Half-width of the interval of d, as a share of the median depth."""
_GOOD_LOO, _USABLE_LOO = 0.005, 0.02
"""Leave-one-out depth error, as a share of the median depth."""
_GOOD_IMAGES = 10
_GOOD_REACH = 1.6
"""Farthest over nearest depth."""


def key_rows(fit: LaserFit) -> list[tuple[str, str]]:
    """Return the figures of the short table, name and value."""
    n, half = fit.plane.vector, fit.half_widths
    rows = [
        ("images with a stripe, used", f"{len(fit.residuals)} of {len(fit.scenes)}"),
        ("stripe", f"{fit.channel}, one point per image {'column' if fit.along_columns else 'row'}"),
        ("stripe points used", f"{fit.points_used} of {fit.points_total}"),
        ("plane normal", f"{n[0]:.5f} {n[1]:.5f} {n[2]:.5f}, ± {np.degrees(fit.tilt_rad):.3f}°"),
        ("plane distance d", f"{_MM * n[3]:.3f} ± {_MM * half[3]:.3f} mm"),
        ("plane RMS, joint", f"{_MM * fit.rms_m:.4f} mm"),
        ("plane RMS, board poses fixed", f"{_MM * fit.pnp_rms_m:.4f} mm"),
        ("depth of an image left out, RMS", f"{_MM * fit.loo_depth_rms_m:.3f} mm"),
        ("corners, RMS", f"{fit.corner_rms_px:.3f} px"),
        ("camera", "refined with the plane" if fit.camera_refined else "held as given"),
        ("range", f"{_MM * fit.range_m[0]:.0f} to {_MM * fit.range_m[1]:.0f} mm"),
    ]
    if fit.table is not None:
        rows.append(("flat table through the arm, RMS", f"{_MM * fit.table.rms_m:.3f} mm over {len(fit.table.names)} images"))
    return rows


def image_rows(fit: LaserFit) -> list[tuple[object, ...]]:
    """Return one row an image whose stripe was used."""
    return [
        (
            item.name,
            f"{int(item.kept.sum())} of {len(item.kept)}",
            f"{_MM * rms(item.distances[item.kept]):.3f}",
            f"{_MM * float(np.median(item.depths)):.0f}",
            f"{_MM * rms(item.loo_depth_errors[item.kept]):.3f}" if len(item.loo_depth_errors) else "–",
        )
        for item in fit.residuals
    ]


def distance_rows(depths: FloatArray, errors: FloatArray) -> list[tuple[str, int, str, str]]:
    """Return bins of equal counts by depth: range, points, bias and RMS in millimetres."""
    if not len(depths):
        return []
    edges = np.quantile(depths, np.linspace(0, 1, _BINS + 1))
    rows = []
    for index, (low, high) in enumerate(itertools.pairwise(edges)):
        inside = (depths >= low) & ((depths < high) if index < _BINS - 1 else (depths <= high))
        if inside.any():
            text = f"{_MM * low:.0f} to {_MM * high:.0f} mm"
            rows.append((text, int(inside.sum()), f"{_MM * errors[inside].mean():+.3f}", f"{_MM * rms(errors[inside]):.3f}"))
    return rows


def loo_by_depth(fit: LaserFit) -> tuple[FloatArray, FloatArray]:
    """Return depths and leave-one-out depth errors of all kept points, metres."""
    told = [item for item in fit.residuals if len(item.loo_depth_errors)]
    if not told:
        return np.empty(0), np.empty(0)
    return np.concatenate([item.depths[item.kept] for item in told]), fit.loo_depth_errors


def verdict(fit: LaserFit) -> tuple[Verdict, str]:
    """Return what the plane is worth, and what to do about it."""
    depth = float(np.median(np.concatenate([item.depths[item.kept] for item in fit.residuals])))
    tilt, shift = np.degrees(fit.tilt_rad), fit.half_widths[3] / depth
    loo = fit.loo_depth_rms_m / depth
    known = f"± {tilt:.2f}° and ± {_MM * fit.half_widths[3]:.2f} mm"
    worth = f"{len(fit.residuals)} images, plane known to {known}, depth to {100 * loo:.1f} %"
    advice = remarks(fit)
    if tilt <= _GOOD_TILT_DEG and shift <= _GOOD_SHIFT and loo <= _GOOD_LOO and len(fit.residuals) >= _GOOD_IMAGES:
        return Verdict.GOOD, worth
    if tilt <= _USABLE_TILT_DEG and shift <= _USABLE_SHIFT and loo <= _USABLE_LOO:
        return Verdict.USABLE, advice[0] if advice else worth
    return Verdict.BAD, f"{worth}; {advice[0] if advice else 'take new images, sharp and with the board flat'}"


def remarks(fit: LaserFit) -> list[str]:
    """Return what to improve, most useful first."""
    depths = np.array([float(np.median(item.depths[item.kept])) for item in fit.residuals if item.kept.any()])
    near, far = _MM * depths.min(), _MM * depths.max()
    told = []
    if far < _GOOD_REACH * near:
        told.append(f"all stripes lie at {near:.0f}–{far:.0f} mm: take more views at {0.6 * near:.0f}–{near:.0f} and {far:.0f}–"
                    f"{1.5 * far:.0f} mm")  # fmt: skip
    if np.degrees(fit.tilt_rad) > _GOOD_TILT_DEG:
        told.append(
            f"the plane's tilt is known to ± {np.degrees(fit.tilt_rad):.2f}° only: take more tilted views at "
            f"{near:.0f}–{far:.0f} mm"
        )
    if len(fit.residuals) < _GOOD_IMAGES:
        told.append(f"{len(fit.residuals)} images show the stripe: take {_GOOD_IMAGES} or more")
    if fit.points_used < 0.8 * fit.points_total:
        lost = fit.points_total - fit.points_used
        told.append(
            f"{lost} of {fit.points_total} stripe points do not fit: keep the board flat and the stripe from being overexposed"
        )
    if not fit.camera_refined:
        told.append("the camera was held as given: the intervals leave its own uncertainty out")
    return told


def summary(fit: LaserFit) -> dict[str, object]:
    """Return the figures for ``summary.json``."""
    depths, errors = loo_by_depth(fit)
    boards = [scene for scene in fit.scenes if scene.board is not None]
    figures: dict[str, object] = {
        "images_total": len(fit.scenes),
        "images_used": len(fit.residuals),
        "rejected": [{"name": item.name, "reason": item.reason} for item in fit.rejected],
        "boards": len(boards),
        "corners_total": sum(len(scene.detection) for scene in boards if scene.detection is not None),
        "corners_used": int(fit.solution.corner_kept.sum()),
        "reprojection_rms_px": fit.corner_rms_px,
        "camera_refined": fit.camera_refined,
        "plane": fit.plane.vector,
        "plane_rms_mm": _MM * fit.rms_m,
        "plane_rms_pnp_mm": _MM * fit.pnp_rms_m,
        "stripe_points_total": fit.points_total,
        "stripe_points_used": fit.points_used,
        "stripe_images": sum(scene.stripe is not None for scene in fit.scenes),
        "stripe_channel": fit.channel,
        "stripe_along_columns": fit.along_columns,
        "loo_depth_rms_mm": _MM * fit.loo_depth_rms_m,
        "loo_depth_by_distance": [dict(zip(("range", "points", "bias_mm", "rms_mm"), row, strict=True))
                                  for row in distance_rows(depths, errors)],
        "intervals": fit.intervals,
        "half_width_deg": np.degrees(fit.tilt_rad),
        "half_width_mm": _MM * fit.half_widths[3],
        "range_m": fit.range_m,
        "remarks": remarks(fit),
    }  # fmt: skip
    if fit.table is not None and fit.hand_eye is not None:
        figures |= {
            "table_rms_mm": _MM * fit.table.rms_m,
            "table_images": len(fit.table.names),
            "T_tool_cam": fit.hand_eye.T_tool_cam,
        }
    return figures


def section(fit: LaserFit) -> dict[str, object]:
    """Return the keys of ``laser0``."""
    return {"plane": fit.plane.vector.tolist(), "range_m": list(fit.range_m)}


def provenance(fit: LaserFit, command: str) -> dict[str, object]:
    """Return where the plane comes from."""
    return {
        "command": command,
        "images": [item.name for item in fit.residuals],
        "residuals": {
            "plane_rms_mm": round(_MM * fit.rms_m, 4),
            "leave_one_out_depth_rms_mm": round(_MM * fit.loo_depth_rms_m, 4),
            "stripe_points_used": fit.points_used,
        },
        "intervals": {name: [float(f"{end:.6g}") for end in ends] for name, ends in fit.intervals.items()},
    }


def make_report(fit: LaserFit) -> Report:
    """Return the report."""
    report = Report("Laser plane calibration")
    report.verdict(*verdict(fit))
    report.table(
        KEY_HEADER, key_rows(fit), "Intervals hold with 95 %, all of the plane's numbers at once: wild bootstrap over images."
    )
    report.bullets(remarks(fit))
    report.heading("Depth by distance")
    depths, errors = loo_by_depth(fit)
    report.table(("depth", "points", "bias mm", "RMS mm"), distance_rows(depths, errors),
                 "Depth by the plane of all other images, less that of the board.")  # fmt: skip
    report.figure(_by_depth(depths, errors), "Each stripe point of an image, by the calibration without that image.")
    report.heading("Residuals along the stripe")
    report.figure(_along(fit), "Distance of the kept points from the plane along the stripe, one row of dots an image: what "
                  "they have in common is the lens or the laser's own bend.")  # fmt: skip
    report.heading("Coverage")
    report.figure(_coverage(fit), "Where the stripes lie in the image, coloured by depth.")
    if fit.table is not None:
        report.heading("One flat table through the arm")
        caption = f"Mean and spread of each image's points about one plane: RMS {_MM * fit.table.rms_m:.3f} mm."
        report.figure(_table(fit), f"{caption} It holds the errors of arm, hand–eye, lens and plane together.")
    report.heading("Images")
    report.table(IMAGE_HEADER, image_rows(fit), "Left out: depth error by the calibration without the image.")
    _rejected(report, fit)
    report.paragraph(
        "The sheet is taken to be flat round the print, for the print's shorter side in each direction. Intervals take the "
        "images as the samples, not the points."
    )
    return report


def rms(values: FloatArray) -> float:
    """Return the root mean square, zero of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def stripe_picture(scene: LaserScene, kept: FloatArray | None = None) -> ByteArray:
    """Return the image in colour with the stripe drawn: green where kept, red where not."""
    pixels = scene.image.pixels if scene.image.stripe_pixels is None else scene.image.stripe_pixels
    picture = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR) if pixels.ndim == 2 else pixels.copy(), np.uint8)
    if scene.stripe is not None:
        used = scene.stripe.kept if kept is None else kept
        for (u, v), good in zip(np.rint(scene.stripe.pixels).astype(int), used, strict=True):
            cv2.circle(picture, (int(u), int(v)), 1, _GREEN if good else _RED, -1)
    return picture


def _rejected(report: Report, fit: LaserFit) -> None:
    if not fit.rejected:
        return
    report.heading("Left out")
    report.table(("image", "reason"), [(item.name, item.reason) for item in fit.rejected])
    scenes = {scene.name: scene for scene in fit.scenes}
    for item in fit.rejected[:_PICTURES]:
        report.picture(stripe_picture(scenes[item.name]), f"{item.name}: {item.reason}")


def _by_depth(depths: FloatArray, errors: FloatArray) -> Figure:
    figure = make_figure()
    axes = figure.add_subplot()
    axes.plot(_MM * depths, _MM * errors, ".", markersize=1.5)
    axes.axhline(0, color="black", linewidth=0.6)
    axes.set(xlabel="depth, mm", ylabel="depth error, mm")
    return figure


def _along(fit: LaserFit) -> Figure:
    figure = make_figure()
    axes = figure.add_subplot()
    for item in fit.residuals:
        axes.plot(_position(fit, item), _MM * item.distances[item.kept], ".", markersize=1.5, label=item.name)
    axes.axhline(0, color="black", linewidth=0.6)
    axes.set(xlabel=f"{'column' if fit.along_columns else 'row'}, px", ylabel="distance from the plane, mm")
    return figure


def _position(fit: LaserFit, item: StripeResidual) -> FloatArray:
    position: FloatArray = item.pixels[item.kept, 0 if fit.along_columns else 1]
    return position


def _coverage(fit: LaserFit) -> Figure:
    figure = make_figure()
    axes = figure.add_subplot()
    pixels = np.concatenate([item.pixels[item.kept] for item in fit.residuals])
    depths = np.concatenate([item.depths[item.kept] for item in fit.residuals])
    drawn = axes.scatter(pixels[:, 0], pixels[:, 1], c=_MM * depths, s=1, cmap="viridis")
    axes.set(xlim=(0, fit.camera.width), ylim=(fit.camera.height, 0), xlabel="u, px", ylabel="v, px", aspect="equal")
    figure.colorbar(drawn, label="depth, mm")
    return figure


def _table(fit: LaserFit) -> Figure:
    figure = make_figure()
    axes = figure.add_subplot()
    parts: Sequence[FloatArray] = fit.table.distances if fit.table is not None else ()
    axes.errorbar(
        np.arange(len(parts)), [_MM * part.mean() for part in parts], [_MM * part.std() for part in parts], fmt="o", markersize=3
    )
    axes.axhline(0, color="black", linewidth=0.6)
    axes.set_xticks(np.arange(len(parts)), fit.table.names if fit.table is not None else (), rotation=90, fontsize=6)
    axes.set(ylabel="distance from the table, mm")
    return figure
