"""What a camera calibration is worth, in words, and what would make it better."""

from __future__ import annotations

from vli_calibration.camera_fit import CameraFit
from vli_calibration.coverage import Coverage
from vli_calibration.report import Verdict

_FOCAL_WEAK, _FOCAL_BAD = 0.01, 0.03
_CENTRE_WEAK, _CENTRE_BAD = 0.01, 0.03
_RMS_WEAK, _RMS_BAD = 0.8e-3, 2.5e-3
"""Of the image's width: 0.5 and 1.6 px at 640."""
_FEW_VIEWS = 10
_LEAST_SHARE = 0.6
_LEAST_REACH = 0.75
_LEAST_TILTED = 3
_LEAST_DEPTH_RATIO = 1.4
_MM = 1e3


def remarks(fit: CameraFit, seen: Coverage) -> list[str]:
    """Return what is weak and what to do about it, the most important first; empty where nothing is."""
    return [*_undetermined(fit), *_scatter(fit), *_views_to_take(fit, seen)]


def verdict(fit: CameraFit, seen: Coverage) -> tuple[Verdict, str]:
    """Return the level, and a sentence for it."""
    found = remarks(fit, seen)
    focal, centre = _relative_sigmas(fit)
    rms = fit.rms_px / fit.camera.width
    if focal > _FOCAL_BAD or centre > _CENTRE_BAD or rms > _RMS_BAD:
        return Verdict.BAD, found[0]
    if found:
        return Verdict.USABLE, found[0]
    return Verdict.GOOD, (
        f"{len(fit.views)} views, {fit.rms_px:.2f} px, focal length to ±{100 * focal:.2f} %, "
        f"corners over {100 * seen.share:.0f} % of the image"
    )


def _relative_sigmas(fit: CameraFit) -> tuple[float, float]:
    """Return the larger standard deviation of fx and fy over the focal length, and of cx and cy over the image's width."""
    return float(fit.sigma[:2].max() / fit.camera.focal_px), float(fit.sigma[2:4].max() / fit.camera.width)


def _undetermined(fit: CameraFit) -> list[str]:
    focal, centre = _relative_sigmas(fit)
    found = []
    if focal > _FOCAL_WEAK:
        found.append(
            f"the views determine fx and fy only to ±{100 * focal:.1f} % (one standard deviation): "
            "take more views tilted by 20–45°, near and far"
        )
    if centre > _CENTRE_WEAK:
        pixels = centre * fit.camera.width
        found.append(
            f"the views determine cx and cy only to ±{pixels:.1f} px (one standard deviation): "
            "take views tilted about both axes, and some with the board turned by 90°"
        )
    return found


def _scatter(fit: CameraFit) -> list[str]:
    if fit.rms_px <= _RMS_WEAK * fit.camera.width:
        return []
    return [
        f"corners scatter by {fit.rms_px:.2f} px: check that the board is flat, the images sharp, "
        "and that the camera is still while one is taken"
    ]


def _views_to_take(fit: CameraFit, seen: Coverage) -> list[str]:
    found = []
    near, far = _MM * seen.distances_m.min(), _MM * seen.distances_m.max()
    if len(fit.views) < _FEW_VIEWS:
        found.append(f"only {len(fit.views)} views: take 20 or more")
    for axis, count, turn in (("horizontal", seen.tilted_about_x, "up and down"), ("vertical", seen.tilted_about_y, "sideways")):
        if count < _LEAST_TILTED:
            found.append(
                f"{count} views are tilted about the {axis} axis: take more tilted {turn} by 20–45° at {near:.0f}–{far:.0f} mm"
            )
    if seen.share < _LEAST_SHARE or seen.reach < _LEAST_REACH:
        where = f", its {seen.empty_side} part first" if seen.empty_side else ""
        found.append(
            f"corners cover {100 * seen.share:.0f} % of the image and reach {100 * seen.reach:.0f} % of the way to its corners, "
            f"beyond which the distortion is a guess: move the board there{where}"
        )
    if far < _LEAST_DEPTH_RATIO * near:
        found.append(f"all views are {near:.0f}–{far:.0f} mm away: take some nearer and further")
    return found
