"""What ``vli calibrate imu`` says of a measurement: verdict, tables, the Allan plot, the summary."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vli_calibration.allan import PRECISION, ImuNoise, SensorNoise
from vli_calibration.imu_recording import ImuRecording
from vli_calibration.noise_model import allan_terms
from vli_calibration.report import Report, Verdict, make_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HEADER = ("sensor", "quantity", "unit", "value", "95 % interval", "x", "y", "z")
_UNITS = {"gyroscope": ("rad/s", "rad/s/√Hz", "rad/s²/√Hz"), "accelerometer": ("m/s²", "m/s²/√Hz", "m/s³/√Hz")}
_COLOURS = ("#b91c1c", "#15803d", "#1d4ed8")
_UNEVEN = 1.5
"""Ratio of the axes' densities from which on one number for all three is worth a remark."""
_DRIFT_SIGMAS = 5.0


def verdict(noise: ImuNoise) -> tuple[Verdict, str]:
    """Return what the measurement is worth and what would make it better."""
    sensors = _sensors(noise)
    short = {name: sensor for name, sensor in sensors.items() if sensor.needed_s > 0}
    if not short:
        return Verdict.GOOD, f"good: noise and random walks of {noise.stretch.duration_s / 3600:.1f} h at rest"
    hours = max(sensor.needed_s for sensor in short.values()) / 3600
    which = " and ".join(short)
    bounds = [name for name, sensor in short.items() if sensor.walk_is_bound]
    written = "; upper bounds are written for it" if bounds else ""
    return Verdict.USABLE, (
        f"noise densities are good; {noise.stretch.duration_s / 3600:.2g} h at rest do not determine the random walk of the "
        f"{which} to {100 * PRECISION:.0f} %{written}: record at rest for about {_readable(hours)}"
    )


def remarks(noise: ImuNoise, recording: ImuRecording) -> list[str]:
    """Return what else the user should know, a sentence each."""
    stretch, lines = noise.stretch, list[str]()
    total_s = float(recording.seconds[-1])
    if stretch.duration_s < 0.99 * total_s:
        lines.append(
            f"used the longest stretch at rest, {stretch.start_s:.1f} to {stretch.end_s:.1f} s of {total_s:.1f} s"
            + (f"; motion at {_spans(stretch.motion_s)}" if stretch.motion_s else "")
        )
    gaps = recording.gaps()
    if gaps:
        start, length = max(gaps, key=lambda gap: gap[1])
        lines.append(
            f"{len(gaps)} gaps in the stamps, the longest {1e3 * length:.0f} ms at {start:.1f} s; "
            f"{stretch.filled} samples filled in"
        )
    if recording.dropped:
        lines.append(f"{recording.dropped} samples dropped: not finite, or not later than the one before")
    for name, sensor in _sensors(noise).items():
        lines += _sensor_remarks(name, sensor)
    return lines


def rows(noise: ImuNoise) -> list[list[object]]:
    """Return the table of :data:`HEADER`."""
    table: list[list[object]] = []
    for name, sensor in _sensors(noise).items():
        _, density, walk = _UNITS[name]
        fit = sensor.fit
        table.append([name, "noise density", density, fit.white, _interval(fit.white_interval), *(a.white for a in sensor.axes)])
        value = f"≤ {sensor.walk:.4g}" if sensor.walk_is_bound else f"{sensor.walk:.4g}"
        table.append([name, "random walk", walk, value, _interval(fit.walk_interval), *(a.walk for a in sensor.axes)])
        if fit.flicker > 0:
            unit = _UNITS[name][0]
            interval = _interval(fit.flicker_interval)
            table.append([name, "bias instability", unit, fit.flicker, interval, *(a.flicker for a in sensor.axes)])
    return table


def summary(noise: ImuNoise, recording: ImuRecording, sentences: list[str]) -> dict[str, object]:
    """Return the content of ``summary.json``."""
    return {
        **noise.section(),
        "duration_s": noise.stretch.duration_s,
        "samples": len(recording.stamps_ns),
        "intervals": intervals(noise),
        "axes": {
            name: {key: [getattr(a, key) for a in sensor.axes] for key in ("white", "walk")}
            for name, sensor in _sensors(noise).items()
        },
        "bias_instability": {name: sensor.fit.flicker for name, sensor in _sensors(noise).items()},
        "random_walk_is_bound": {name: sensor.walk_is_bound for name, sensor in _sensors(noise).items()},
        "needed_s": {name: sensor.needed_s for name, sensor in _sensors(noise).items()},
        "remarks": sentences,
    }


def intervals(noise: ImuNoise) -> dict[str, list[float]]:
    """Return the 95 % intervals by the calibration file's keys."""
    found = {}
    for name, sensor in _sensors(noise).items():
        found[f"{name}_noise_density"] = list(sensor.fit.white_interval)
        found[f"{name}_random_walk"] = list(sensor.fit.walk_interval)
    return {key: [float(f"{value:.4g}") for value in values] for key, values in found.items()}


def provenance(noise: ImuNoise, command: str) -> dict[str, Any]:
    """Return where section ``imu0`` comes from, for the calibration file."""
    bounds = [f"{name}_random_walk" for name, sensor in _sensors(noise).items() if sensor.walk_is_bound]
    return {
        "command": command,
        "duration_s": round(noise.stretch.duration_s, 1),
        "intervals": intervals(noise),
        **({"upper_bounds": bounds} if bounds else {}),
    }


def make_report(noise: ImuNoise, recording: ImuRecording) -> Report:
    """Return the page, verdict first."""
    report = Report("IMU noise")
    report.verdict(*verdict(noise))
    report.table(HEADER, rows(noise), "All three axes together, as written to the calibration, and each axis alone.")
    report.bullets(remarks(noise, recording))
    report.heading("Allan deviation")
    for name, sensor in _sensors(noise).items():
        figure = make_figure(7.0, 4.2)
        _draw(figure.subplots(), sensor, _UNITS[name][0])
        report.figure(
            figure, f"{name.capitalize()}: overlapping Allan deviation of the axes and the fitted model with its parts."
        )
    report.paragraph(
        "The densities are the most likely ones given every frequency of the recording, not read off these curves: towards long "
        "τ the curves scatter, since few independent averages are left. A bump is a vibration, a rise steeper than the model's a "
        "change of temperature: let the sensor warm up, and keep draughts and machines away."
    )
    return report


def _draw(axes: Axes, sensor: SensorNoise, unit: str) -> None:
    taus, fit = sensor.taus_s, sensor.fit
    for column, name, colour in zip(sensor.deviation.T, "xyz", _COLOURS, strict=True):
        axes.loglog(taus, column, color=colour, lw=1.2, label=name)
    axes.loglog(taus, fit.allan_deviation(taus), color="black", lw=1.6, ls="--", label="model")
    terms = np.sqrt(allan_terms(taus) * np.square([fit.white, fit.flicker, fit.walk]))
    low = 0.5 * float(sensor.deviation.min())
    for part, label, style in zip(terms.T, ("white noise", "bias instability", "random walk"), (":", "-", "-."), strict=True):
        if part.max() > low:
            axes.loglog(taus, np.where(part > low, part, np.nan), color="#64748b", lw=1.0, ls=style, label=label)
    axes.plot([1.0], [fit.white], "o", color="#64748b", ms=5)
    axes.set(xlabel="τ, s", ylabel=f"Allan deviation, {unit}")
    axes.grid(visible=True, which="major", alpha=0.25)
    axes.legend(frameon=False, ncols=2)


def _sensors(noise: ImuNoise) -> dict[str, SensorNoise]:
    return {"gyroscope": noise.gyro, "accelerometer": noise.accel}


def _sensor_remarks(name: str, sensor: SensorNoise) -> list[str]:
    lines = []
    white = [axis.white for axis in sensor.axes]
    if max(white) > _UNEVEN * min(white):
        lines.append(
            f"the {name}'s axes differ: noise density {min(white):.3g} to {max(white):.3g}; the one value written is their mean"
        )
    drift = np.abs(sensor.fit.drift)
    if (drift > _DRIFT_SIGMAS * sensor.fit.drift_sigma).any():
        lines.append(
            f"the {name} drifts by {3600 * drift.max():.3g} {_UNITS[name][0]} an hour, more than its walk explains: "
            "let it warm up before recording"
        )
    if sensor.fit.flicker > 0 and sensor.walk_is_bound:
        lines.append(
            f"the {name}'s bias instability of {sensor.fit.flicker:.3g} {_UNITS[name][0]} hides its random walk; "
            f"the upper bound {sensor.walk:.3g} is written"
        )
    return lines


def _interval(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.3g} to {ends[1]:.3g}"


def _spans(spans: list[tuple[float, float]], most: int = 5) -> str:
    text = ", ".join(f"{start:.1f}–{end:.1f} s" for start, end in spans[:most])
    return text + (f" and {len(spans) - most} times more" if len(spans) > most else "")


def _readable(hours: float) -> str:
    return f"{np.ceil(hours):.0f} h" if hours > 1.5 else f"{np.ceil(60 * hours):.0f} min"
