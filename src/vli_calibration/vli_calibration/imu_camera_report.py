"""What ``vli calibrate imu-camera`` says of a fit: verdict, tables, residual plots, the summary."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vli_calibration.imu_camera import ImuCameraFit
from vli_calibration.report import Report, Verdict, make_figure
from vli_common.arrays import FloatArray
from vli_common.geometry import so3_log

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HEADER = ("quantity", "x", "y", "z", "±95 % x", "y ", "z ")
_GOOD_ROTATION, _GOOD_TRANSLATION, _GOOD_TIME_S = np.deg2rad(0.1), 0.5e-3, 0.3e-3
_USABLE = 4.0
"""Times the half-widths of a good calibration."""
_CONSISTENT, _HARDLY_CONSISTENT = 1.5, 4.0
_WEAK_RATE = 0.5
"""Of the liveliest axis' angular rate: axes below it are named."""
_AXES = ("x (to the right)", "y (down)", "z (viewing direction)")
_SCALE_REMARK = 0.01
_FEW_BOARDS = 0.5
_COLOURS = ("#b91c1c", "#15803d", "#1d4ed8")


def verdict(fit: ImuCameraFit) -> tuple[Verdict, str]:
    """Return what the fit is worth, and what to do about it."""
    worst = max(
        fit.rotation_half_width.max() / _GOOD_ROTATION,
        fit.translation_half_width.max() / _GOOD_TRANSLATION,
        fit.timeshift_half_width_s / _GOOD_TIME_S,
    )
    turn, move = np.rad2deg(fit.rotation_half_width.max()), 1e3 * fit.translation_half_width.max()
    known = f"rotation ±{turn:.3f}°, translation ±{move:.2f} mm, time offset ±{1e3 * fit.timeshift_half_width_s:.3f} ms"
    if worst > 1:
        level = Verdict.USABLE if worst < _USABLE else Verdict.BAD
        return level, f"{known}: record again and {_advice(fit)}"
    if fit.consistency > _CONSISTENT:
        level = Verdict.USABLE if fit.consistency < _HARDLY_CONSISTENT else Verdict.BAD
        return level, (
            f"camera and IMU disagree {fit.consistency:.1f} times more than their noise allows ({known}): check the camera's "
            "calibration and section imu0 ('vli calibrate imu'), that the board does not move, and that camera and IMU are rigid"
        )
    return Verdict.GOOD, known


def remarks(fit: ImuCameraFit, total: int) -> list[str]:
    """Return what else the user should know.

    Args:
        fit: the result.
        total: frames in which the board was looked for.
    """
    lines = []
    if len(fit.track) < _FEW_BOARDS * total:
        lines.append(f"the board was found in {len(fit.track)} of {total} frames: keep it in view, in focus and lit")
    if fit.outliers:
        lines.append(f"{fit.outliers} frames left out: their board does not fit the motion")
    scale = fit.gravity / 9.806 - 1
    if abs(scale) > _SCALE_REMARK:
        lines.append(f"the accelerometer measures gravity as {fit.gravity:.2f} m/s²: its scale is off by {100 * scale:.1f} %")
    return lines


def rows(fit: ImuCameraFit) -> list[list[object]]:
    """Return the table of :data:`HEADER`."""
    turn = np.rad2deg(so3_log(fit.T_cam_imu[:3, :3]))
    half_turn, half_move = np.rad2deg(fit.rotation_half_width), 1e3 * fit.translation_half_width
    move = 1e3 * fit.T_cam_imu[:3, 3]
    return [
        ["rotation vector, °", *(f"{value:.3f}" for value in turn), *(f"{value:.3f}" for value in half_turn)],
        ["translation, mm", *(f"{value:.2f}" for value in move), *(f"{value:.2f}" for value in half_move)],
        ["time offset, ms", f"{1e3 * fit.timeshift_s:.3f}", None, None, f"{1e3 * fit.timeshift_half_width_s:.3f}", None, None],
    ]


def key_rows(fit: ImuCameraFit, total: int, reprojection_px: float) -> list[list[object]]:
    """Return figure and value of what the result rests on."""
    rate = np.rad2deg(fit.alignment.rate_rms)
    bias = fit.frames.biases.mean(axis=0)
    return [
        ["frames with the board", f"{len(fit.track)} of {total}"],
        ["corners", sum(map(len, fit.track.corners))],
        ["reprojection RMS, px", f"{reprojection_px:.3f}"],
        ["consistency (1: as the noise says)", f"{fit.consistency:.2f}"],
        ["angular rate, rms, °/s about x, y, z", " ".join(f"{value:.0f}" for value in rate)],
        ["gravity as measured, m/s²", f"{fit.gravity:.3f}"],
        ["gyroscope's bias, rad/s", " ".join(f"{value:.4f}" for value in bias[3:])],
        ["accelerometer's bias, m/s²", " ".join(f"{value:.3f}" for value in bias[:3])],
    ]


def intervals(fit: ImuCameraFit) -> dict[str, list[list[float]]]:
    """Return the 95 % intervals [low, high]: degrees about and millimetres along the camera's axes, milliseconds."""
    turn, move = np.rad2deg(fit.rotation_half_width), 1e3 * fit.translation_half_width
    centre = 1e3 * fit.T_cam_imu[:3, 3]
    shift, half = 1e3 * fit.timeshift_s, 1e3 * fit.timeshift_half_width_s
    return {
        "rotation_deg": [[round(-value, 4), round(value, 4)] for value in turn.tolist()],
        "translation_mm": [
            [round(x - value, 3), round(x + value, 3)] for x, value in zip(centre.tolist(), move.tolist(), strict=True)
        ],
        "timeshift_ms": [[round(shift - half, 4), round(shift + half, 4)]],
    }


def section(fit: ImuCameraFit) -> dict[str, Any]:
    """Return what goes into cam0."""
    return {"T_cam_imu": fit.T_cam_imu.tolist(), "timeshift_cam_imu": round(fit.timeshift_s, 7)}


def provenance(fit: ImuCameraFit, command: str, total: int, reprojection_px: float) -> dict[str, Any]:
    """Return where T_cam_imu comes from."""
    return {
        "command": command,
        "images": f"{len(fit.track)} of {total}",
        "reprojection_rms_px": round(reprojection_px, 4),
        "consistency": round(fit.consistency, 3),
        "intervals": intervals(fit),
    }


def summary(fit: ImuCameraFit, total: int, reprojection_px: float, sentences: list[str]) -> dict[str, object]:
    """Return the content of ``summary.json``."""
    return {
        "images_total": total,
        "images_used": len(fit.track),
        "corners_used": sum(map(len, fit.track.corners)),
        "reprojection_rms_px": reprojection_px,
        **section(fit),
        "gravity": fit.gravity,
        "consistency": fit.consistency,
        "correlation": fit.alignment.correlation,
        "rate_rms_deg": np.rad2deg(fit.alignment.rate_rms),
        "intervals": intervals(fit),
        "outliers": fit.outliers,
        "remarks": sentences,
    }


def make_report(fit: ImuCameraFit, total: int, frame_errors_px: list[FloatArray], sentences: list[str]) -> Report:
    """Return the page, verdict first.

    Args:
        fit: the result.
        total: frames in which the board was looked for.
        frame_errors_px: reprojection errors (K, 2) of each frame.
        sentences: see :func:`remarks`.
    """
    report = Report("Camera and IMU")
    report.verdict(*verdict(fit))
    report.table(
        HEADER, rows(fit), "T_cam_imu and the time offset: t_imu = t_cam + offset. Intervals along and about the camera's axes."
    )
    report.table(("figure", "value"), key_rows(fit, total, rms(frame_errors_px)))
    report.bullets(sentences)
    report.heading("Residuals")
    seconds = fit.frame_seconds
    figure = make_figure(7.0, 2.6)
    axes = figure.subplots()
    axes.plot(seconds, [float(np.sqrt((error**2).sum(axis=1).mean())) for error in frame_errors_px], color="#475569", lw=0.9)
    axes.set(xlabel="time, s", ylabel="reprojection RMS, px", ylim=(0, None))
    report.figure(figure, "The board's corners where the solution expects them, against where they were found, frame by frame.")
    figure = make_figure(7.0, 4.4)
    top, bottom = figure.subplots(2, 1, sharex=True)
    _residuals(top, seconds[1:], np.rad2deg(fit.gyro_residuals), "gyroscope, °/s")
    _residuals(bottom, seconds[1:], fit.accel_residuals, "accelerometer, m/s²")
    bottom.set_xlabel("time, s")
    report.figure(
        figure, "What the IMU measured from frame to frame against the motion of the solution: noise, without a pattern."
    )
    report.heading("Motion")
    figure = make_figure(7.0, 2.6)
    _residuals(figure.subplots(), seconds[1:], np.rad2deg(fit.rates), "angular rate, °/s")
    report.figure(
        figure, "How the sensor was turned, about its own axes: the three should be alike in size and none like another."
    )
    return report


def rms(errors: list[FloatArray]) -> float:
    """Return the RMS length of errors (K, 2)."""
    return float(np.sqrt((np.concatenate(errors) ** 2).sum(axis=1).mean()))


def _residuals(axes: Axes, seconds: FloatArray, values: FloatArray, label: str) -> None:
    for column, name, colour in zip(values.T, "xyz", _COLOURS, strict=True):
        axes.plot(seconds, column, color=colour, lw=0.7, label=name)
    axes.axhline(0, color="#64748b", lw=0.6)
    axes.set_ylabel(label)
    axes.legend(frameon=False, ncols=3, loc="upper right")


def _advice(fit: ImuCameraFit) -> str:
    rate = fit.alignment.rate_rms
    weak = [name for name, value in zip(_AXES, rate, strict=True) if value < _WEAK_RATE * rate.max()]
    if weak:
        return f"rotate more about the camera's {' and '.join(weak)}"
    if np.rad2deg(np.linalg.norm(rate)) < 60:
        return "rotate faster about all three axes"
    return "move for longer, about all three axes"
