"""The report of ``vli calibrate camera``: tables, drawings, pictures of what was rejected, and the figures for machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vli_calibration.camera_fit import CameraFit, FittedView
from vli_calibration.camera_quality import remarks, verdict
from vli_calibration.camera_selection import Selection
from vli_calibration.coverage import Coverage
from vli_calibration.lens import LENSES
from vli_calibration.report import Report, make_figure
from vli_calibration.targets import Target
from vli_calibration.types import Rejection
from vli_common.arrays import ByteArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MM = 1e3
_PICTURES = 12
_CORNER_PICTURES = 3
_FIELD_CELLS = (12, 8)
_GREEN, _RED = (80, 200, 60), (40, 40, 240)
PARAMETER_HEADER = ("parameter", "value", "σ", "95 % interval")
VIEW_HEADER = ("image", "corners", "RMS px", "left out px", "distance mm", "tilt °")


@dataclass(frozen=True, slots=True)
class CameraCalibration:
    """All that a camera calibration found.

    Args:
        selection: the fit and what it was chosen among.
        target: what was in the images.
        seen: the coverage of the corners that were kept.
        rejected: images that were not used, by the detection or by the fit, with reasons.
        images_total: images that were given.
        corners_total: corners that were found, in all images.
    """

    selection: Selection
    target: Target
    seen: Coverage
    rejected: tuple[Rejection, ...]
    images_total: int
    corners_total: int

    @property
    def fit(self) -> CameraFit:
        """The fit that was chosen."""
        return self.selection.fit


def key_rows(found: CameraCalibration) -> list[tuple[str, str]]:
    """Return the figures of the short table, name and value."""
    fit, seen = found.fit, found.seen
    near, far = _MM * seen.distances_m.min(), _MM * seen.distances_m.max()
    return [
        ("images used", f"{len(fit.views)} of {found.images_total}"),
        ("corners used", f"{fit.corners_used} of {found.corners_total}"),
        ("model", fit.model),
        ("reprojection RMS", f"{fit.rms_px:.3f} px"),
        ("images left out, RMS", f"{fit.loo_rms_px:.3f} px"),
        ("image covered", f"{100 * seen.share:.0f} %"),
        ("distances", f"{near:.0f} to {far:.0f} mm"),
        ("tilts", f"{seen.tilts_deg.min():.0f} to {seen.tilts_deg.max():.0f}°"),
    ]


def parameter_rows(fit: CameraFit) -> list[tuple[str, str, str, str]]:
    """Return the parameters with standard deviations and intervals."""
    rows = []
    for name, value, sigma in zip(fit.names, fit.parameters, fit.sigma, strict=True):
        low, high = fit.intervals[name]
        digits = 2 if name in fit.names[:4] else 5
        rows.append((name, f"{value:.{digits}f}", f"{sigma:.{digits}f}", f"{low:.{digits}f} to {high:.{digits}f}"))
    return rows


def view_rows(found: CameraCalibration) -> list[tuple[object, ...]]:
    """Return one row an image that was used."""
    return [
        (
            view.name,
            f"{int(view.kept.sum())} of {len(view.detection)}",
            f"{view.rms_px:.3f}",
            f"{view.loo_rms_px:.3f}",
            f"{_MM * distance:.0f}",
            f"{tilt:.0f}",
        )
        for view, distance, tilt in zip(found.fit.views, found.seen.distances_m, found.seen.tilts_deg, strict=True)
    ]


def summary(found: CameraCalibration) -> dict[str, object]:
    """Return the figures for ``summary.json``."""
    fit, seen = found.fit, found.seen
    return {
        "images_total": found.images_total,
        "images_used": len(fit.views),
        "rejected": [{"name": item.name, "reason": item.reason} for item in found.rejected],
        "corners_total": found.corners_total,
        "corners_used": fit.corners_used,
        "reprojection_rms_px": fit.rms_px,
        "leave_one_out_rms_px": fit.loo_rms_px,
        "model": fit.model,
        "distortion_model": LENSES[fit.model].model,
        "model_choice": found.selection.sentence,
        "target": found.target.spec,
        "intrinsics": fit.parameters[:4],
        "distortion_coeffs": fit.parameters[4:],
        "sigma": dict(zip(fit.names, fit.sigma, strict=True)),
        "intervals": fit.intervals,
        "image_share": seen.share,
        "distances_m": [seen.distances_m.min(), seen.distances_m.max()],
        "tilts_deg": [seen.tilts_deg.min(), seen.tilts_deg.max()],
        "remarks": remarks(fit, seen),
    }


def section(fit: CameraFit) -> dict[str, object]:
    """Return the keys of ``cam0``."""
    return {
        "camera_model": "pinhole",
        "intrinsics": fit.parameters[:4].tolist(),
        "distortion_model": LENSES[fit.model].model,
        "distortion_coeffs": fit.parameters[4:].tolist(),
        "resolution": [fit.camera.width, fit.camera.height],
    }


def provenance(found: CameraCalibration, command: str) -> dict[str, object]:
    """Return where ``cam0`` comes from."""
    return {
        "command": command,
        "target": found.target.spec,
        "images": [view.name for view in found.fit.views],
        "residuals": {
            "reprojection_rms_px": round(found.fit.rms_px, 4),
            "leave_one_out_rms_px": round(found.fit.loo_rms_px, 4),
            "corners_used": found.fit.corners_used,
        },
        "intervals": {name: [float(f"{end:.6g}") for end in ends] for name, ends in found.fit.intervals.items()},
    }


def make_report(found: CameraCalibration, pictures: Mapping[str, ByteArray]) -> Report:
    """Return the report.

    Args:
        found: what to report.
        pictures: image by name, for those that were rejected or lost corners.
    """
    report = Report("Camera calibration")
    report.verdict(*verdict(found.fit, found.seen))
    report.table(("figure", "value"), key_rows(found))
    report.bullets(remarks(found.fit, found.seen))
    report.paragraph(
        f"Lengths rest on the stated size of the target, {found.target.spec}; images of one camera cannot tell a wrong one. "
        "Measure the print with a ruler."
    )
    report.heading("Parameters")
    report.table(PARAMETER_HEADER, parameter_rows(found.fit), "σ: the larger of the residuals' and of the jackknife over images")
    report.paragraph(found.selection.sentence[0].upper() + found.selection.sentence[1:] + ".")
    report.heading("Residuals")
    report.figure(_scatter(found.fit), "Residual of every corner, projected minus seen; those left out in red")
    report.figure(_bars(found.fit), "RMS of each image, and with the camera of all other images")
    report.figure(_field(found.fit), "Mean residual over the image: a pattern here is what the lens model cannot follow")
    report.heading("Coverage")
    report.figure(_map(found.fit), "Corners in the image; those left out in red")
    report.table(VIEW_HEADER, view_rows(found))
    _add_rejected(report, found, pictures)
    return report


def _add_rejected(report: Report, found: CameraCalibration, pictures: Mapping[str, ByteArray]) -> None:
    if found.rejected:
        report.heading("Rejected images")
        report.table(("image", "reason"), [(item.name, item.reason) for item in found.rejected])
        for item in [item for item in found.rejected if item.name in pictures][:_PICTURES]:
            report.picture(brightened(pictures[item.name]), f"{item.name}: {item.reason}")
    lossy = sorted((view for view in found.fit.views if not view.kept.all()), key=lambda view: int(view.kept.sum()))
    if lossy:
        report.heading("Rejected corners")
        for view in [view for view in lossy if view.name in pictures][:_CORNER_PICTURES]:
            report.picture(marked(pictures[view.name], view), f"{view.name}: {int((~view.kept).sum())} corners left out, in red")


def brightened(pixels: ByteArray) -> ByteArray:
    """Return an image (H, W) or (H, W, 3) in which a dark scene can be seen."""
    white = max(float(np.quantile(pixels, 0.99)), 16.0)
    return np.asarray(np.clip(pixels * (230.0 / white), 0, 255), dtype=np.uint8)


def marked(pixels: ByteArray, view: FittedView) -> ByteArray:
    """Return the image with its corners, green kept, red left out."""
    picture = brightened(pixels)
    picture = np.dstack([picture] * 3) if picture.ndim == 2 else np.ascontiguousarray(picture[:, :, :3])
    radius = max(3, picture.shape[1] // 160)
    for (u, v), kept in zip(view.detection.pixels, view.kept, strict=True):
        cv2.circle(picture, (round(u), round(v)), radius, _GREEN if kept else _RED, max(1, radius // 3), cv2.LINE_AA)
    return picture


def _split(views: Sequence[FittedView]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return residuals and pixels (N, 2) of the kept corners, then of those left out."""
    kept = np.concatenate([view.kept for view in views])
    residual = np.vstack([view.residuals for view in views])
    pixels = np.vstack([view.detection.pixels for view in views])
    return residual[kept], pixels[kept], residual[~kept], pixels[~kept]


def _scatter(fit: CameraFit) -> Figure:
    figure = make_figure(5.0, 4.6)
    axes = figure.subplots()
    kept, _, lost, _ = _split(fit.views)
    limit = 1.15 * float(np.abs(kept).max(initial=0.1))
    axes.plot(*kept.T, ".", markersize=2, color="tab:blue", label=f"{len(kept)} kept")
    inside = np.abs(lost).max(axis=1, initial=0.0) < limit
    axes.plot(
        *lost[inside].T, "x", markersize=4, color="tab:red", label=f"{len(lost)} left out, {(~inside).sum()} beyond the edge"
    )
    axes.set(xlim=(-limit, limit), ylim=(-limit, limit), xlabel="u, px", ylabel="v, px", aspect="equal")
    axes.legend(loc="upper right")
    return figure


def _bars(fit: CameraFit) -> Figure:
    figure = make_figure(7.0, 3.2)
    axes = figure.subplots()
    place = np.arange(len(fit.views))
    axes.bar(place, [view.rms_px for view in fit.views], color="tab:blue", label="in the fit")
    axes.plot(place, [view.loo_rms_px for view in fit.views], "_", color="tab:orange", markersize=8, label="left out")
    axes.axhline(fit.rms_px, color="tab:gray", linewidth=0.8)
    axes.set_xticks(place, [view.name.rsplit(".", 1)[0] for view in fit.views], rotation=90, fontsize=7)
    axes.set(ylabel="RMS, px", xlim=(-0.7, len(place) - 0.3))
    axes.legend(loc="upper right")
    return figure


def _field(fit: CameraFit) -> Figure:
    residual, pixels, _, _ = _split(fit.views)
    width, height = fit.camera.width, fit.camera.height
    columns, rows = _FIELD_CELLS
    cell = np.clip(((pixels + 0.5) / [width, height] * _FIELD_CELLS).astype(int), 0, np.array(_FIELD_CELLS) - 1)
    index = cell[:, 1] * columns + cell[:, 0]
    count = np.maximum(np.bincount(index, minlength=columns * rows), 1)
    mean = [np.bincount(index, weights=values, minlength=columns * rows) / count for values in (*residual.T, *pixels.T)]
    filled = np.bincount(index, minlength=columns * rows) >= 3
    du, dv, u, v = (values[filled] for values in mean)
    figure = make_figure(6.0, 6.0 * height / width + 0.6)
    axes = figure.subplots()
    largest = float(np.hypot(du, dv).max(initial=1e-6))
    arrows = axes.quiver(
        u, v, du, dv, angles="xy", scale_units="xy", scale=largest / (width / columns), color="tab:blue", width=0.004
    )
    axes.quiverkey(arrows, 0.9, 1.04, largest, f"{largest:.2f} px")
    axes.set(xlim=(0, width), ylim=(height, 0), xlabel="u, px", ylabel="v, px", aspect="equal")
    return figure


def _map(fit: CameraFit) -> Figure:
    _, kept, _, lost = _split(fit.views)
    width, height = fit.camera.width, fit.camera.height
    figure = make_figure(6.0, 6.0 * height / width + 0.4)
    axes = figure.subplots()
    axes.plot(*kept.T, ".", markersize=2, color="tab:blue")
    axes.plot(*lost.T, "x", markersize=4, color="tab:red")
    axes.set(xlim=(0, width), ylim=(height, 0), xlabel="u, px", ylabel="v, px", aspect="equal")
    return figure
