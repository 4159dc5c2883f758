"""The report of ``vli calibrate check``: bias and flatness by distance, in tables, drawings and words."""

from __future__ import annotations

import numpy as np

from vli_calibration.laser_check import LaserCheck
from vli_calibration.laser_report import distance_rows, rms, stripe_picture
from vli_calibration.report import Report, Verdict, make_figure

IMAGE_HEADER = ("image", "points", "depth mm", "bias mm", "RMS mm", "flatness mm")
DISTANCE_HEADER = ("depth", "points", "bias mm", "RMS mm")
_MM = 1e3
_PICTURES = 6
_GOOD, _USABLE = 0.005, 0.02
"""RMS depth error, as a share of the depth."""


def image_rows(check: LaserCheck) -> list[tuple[object, ...]]:
    """Return one row an image."""
    return [
        (
            image.name,
            len(image.errors),
            f"{_MM * float(np.median(image.depths)):.0f}",
            f"{_MM * image.bias_m:+.3f}",
            f"{_MM * rms(image.errors):.3f}",
            f"{_MM * rms(image.flatness):.3f}",
        )
        for image in check.images
    ]


def verdict(check: LaserCheck) -> tuple[Verdict, str]:
    """Return how far to trust the calibration, and what to do where that is not far."""
    share = rms(check.errors / check.depths)
    figures = f"depth off by {100 * share:.2f} % RMS, {_MM * check.bias_m:+.2f} mm on average, over {len(check.images)} images"
    if share <= _GOOD:
        return Verdict.GOOD, figures
    rows = distance_rows(check.depths, check.errors)
    worst = max(rows, key=lambda row: float(row[3]))[0]
    what = f"{figures}, most at {worst}"
    if share <= _USABLE:
        return Verdict.USABLE, f"{what}: for better, re-run 'vli calibrate laser' with tilted views there"
    return Verdict.BAD, f"{what}: re-run 'vli calibrate camera' and 'vli calibrate laser'; did the laser or the lens move?"


def summary(check: LaserCheck) -> dict[str, object]:
    """Return the figures for ``summary.json``."""
    rows = distance_rows(check.depths, check.errors)
    return {
        "images_total": len(check.scenes),
        "images_used": len(check.images),
        "rejected": [{"name": item.name, "reason": item.reason} for item in check.rejected],
        "stripe_points_used": len(check.errors),
        "flatness_rms_mm": _MM * check.flatness_rms_m,
        "bias_mm": _MM * check.bias_m,
        "depth_rms_mm": _MM * check.error_rms_m,
        "depth_rms_share": rms(check.errors / check.depths),
        "by_distance": [dict(zip(("range", "points", "bias_mm", "rms_mm"), row, strict=True)) for row in rows],
    }


def make_report(check: LaserCheck) -> Report:
    """Return the report."""
    report = Report("Calibration check")
    report.verdict(*verdict(check))
    report.table(
        DISTANCE_HEADER, distance_rows(check.depths, check.errors), "Triangulated depth less that of the board from its corners."
    )
    report.table(
        ("figure", "value"),
        [
            ("flatness RMS", f"{_MM * check.flatness_rms_m:.3f} mm"),
            ("mean depth error", f"{_MM * check.bias_m:+.3f} mm"),
            ("RMS depth error", f"{_MM * check.error_rms_m:.3f} mm"),
        ],
        "Flatness: what is left of each stripe after a straight line; noise and bends, not offsets.",
    )
    figure = make_figure()
    axes = figure.add_subplot()
    for image in check.images:
        axes.plot(_MM * image.depths, _MM * image.errors, ".", markersize=1.5)
    axes.axhline(0, color="black", linewidth=0.6)
    axes.set(xlabel="depth, mm", ylabel="depth error, mm")
    report.figure(figure, "Depth error of every stripe point by depth.")
    report.heading("Images")
    report.table(IMAGE_HEADER, image_rows(check))
    worst = sorted(check.images, key=lambda image: -rms(image.errors))[:_PICTURES]
    scenes = {scene.name: scene for scene in check.scenes}
    for image in worst:
        report.picture(stripe_picture(scenes[image.name]), f"{image.name}: {_MM * image.bias_m:+.3f} mm on average")
    if check.rejected:
        report.heading("Left out")
        report.table(("image", "reason"), [(item.name, item.reason) for item in check.rejected])
    return report
