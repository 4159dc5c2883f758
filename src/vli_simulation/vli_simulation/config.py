"""What a simulated recording is made of: motion, rig, sensor and IMU; presets for the usual lengths."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from vli_common.config import from_mapping, parameter, section, to_mapping
from vli_common.errors import VliError


class SimulationError(VliError):
    """The recording that was asked for cannot be simulated."""


@dataclass(frozen=True)
class MotionConfig:
    """How the hand moves: straight passes, back and forth, with sway and tremor on top."""

    duration_s: float = parameter(25.0, unit="s", minimum=0.2, maximum=3600.0, doc="length of the recording")
    passes: int = parameter(2, minimum=1, maximum=100, doc="straight passes, every second one backwards")
    speed: float = parameter(
        0.014, unit="m/s", minimum=0.0, maximum=0.5, doc="mean speed while moving; zero: the sensor stands still"
    )
    distance: float = parameter(
        0.03, unit="m", minimum=0.015, maximum=0.15, doc="camera to surface; longer: wider view, coarser depth"
    )
    rest_s: float = parameter(
        1.5, unit="s", minimum=0.0, maximum=60.0, doc="at rest before the first pass; zero: starts in full motion"
    )
    sway: float = parameter(
        1.0, minimum=0.0, maximum=5.0, doc="scale of the slow wandering of the hand, millimetres and degrees below 1 Hz"
    )
    tremor: float = parameter(
        1.0, minimum=0.0, maximum=10.0, doc="scale of the hand's tremor, 0.1 mm and 0.1 degrees at 4 to 12 Hz"
    )


@dataclass(frozen=True)
class RigConfig:
    """Camera, lens, laser and light, all rigidly connected."""

    width: int = parameter(640, unit="px", minimum=64, maximum=4096, doc="image width")
    height: int = parameter(480, unit="px", minimum=48, maximum=4096, doc="image height")
    lens: str = parameter("radtan", choices=("radtan", "equidistant", "none"), doc="lens distortion model")
    stripe_angle_deg: float = parameter(
        0.0, unit="degrees", minimum=-180.0, maximum=180.0, doc="stripe in the image: 0 along rows, 90 along columns"
    )
    laser_colour: str = parameter("red", choices=("red", "blue"), doc="wavelength of the laser, 650 or 450 nm")
    baseline: float = parameter(
        0.015, unit="m", minimum=0.004, maximum=0.1, doc="laser to camera; longer: finer depth, more occlusion"
    )
    rate_hz: float = parameter(60.0, unit="Hz", minimum=2.0, maximum=500.0, doc="long and short frames together")


@dataclass(frozen=True)
class SensorConfig:
    """Exposure, noise and encoding of the image sensor."""

    exposure_long_s: float = parameter(
        0.005, unit="s", minimum=1e-5, maximum=0.1, doc="laser off; longer: brighter and more motion blur"
    )
    exposure_short_s: float = parameter(
        0.0004, unit="s", minimum=1e-6, maximum=0.1, doc="laser on; longer: the stripe saturates more"
    )
    full_well_e: float = parameter(
        9000.0, unit="electrons", minimum=100.0, maximum=1e6, doc="charge at 255; smaller: more shot noise"
    )
    read_noise_e: float = parameter(22.0, unit="electrons", minimum=0.0, maximum=1e4, doc="noise of a dark pixel")
    black_level: float = parameter(1.0, unit="grey levels", minimum=0.0, maximum=64.0, doc="grey level of a dark pixel")
    speckle: float = parameter(
        0.25, minimum=0.0, maximum=1.0, doc="contrast of the laser's speckle, the floor of stripe detection"
    )
    vignetting: float = parameter(0.35, minimum=0.0, maximum=0.9, doc="loss of light at the corner of the image")
    encoding: str = parameter(
        "jpeg", choices=("jpeg", "bayer", "bayer-png", "rgb", "mono"), doc="of the images in the bag; bayer: raw mosaic"
    )
    quality: int = parameter(90, minimum=1, maximum=100, doc="of jpeg; higher: larger bag")


@dataclass(frozen=True)
class ImuConfig:
    """The IMU: rate and noise as written to the calibration, constant part of the biases."""

    rate_hz: float = parameter(200.0, unit="Hz", minimum=20.0, maximum=2000.0, doc="samples a second")
    accelerometer_noise_density: float = parameter(
        2.0e-3, unit="m/s²/√Hz", minimum=0.0, maximum=1.0, doc="white noise of the accelerometer"
    )
    accelerometer_random_walk: float = parameter(3.0e-4, unit="m/s³/√Hz", minimum=0.0, maximum=1.0, doc="walk of its bias")
    gyroscope_noise_density: float = parameter(
        2.4e-4, unit="rad/s/√Hz", minimum=0.0, maximum=1.0, doc="white noise of the gyroscope"
    )
    gyroscope_random_walk: float = parameter(2.0e-5, unit="rad/s²/√Hz", minimum=0.0, maximum=1.0, doc="walk of its bias")
    accelerometer_bias: float = parameter(
        0.08, unit="m/s²", minimum=0.0, maximum=2.0, doc="one standard deviation of the constant bias"
    )
    gyroscope_bias: float = parameter(
        0.006, unit="rad/s", minimum=0.0, maximum=0.2, doc="one standard deviation of the constant bias"
    )
    noise_scale: float = parameter(
        1.0, minimum=0.0, maximum=100.0, doc="scales noise, walk and bias; the calibration keeps the densities above"
    )


@dataclass(frozen=True)
class SimulationConfig:
    """Everything that decides a recording, besides scene and seed."""

    motion: MotionConfig = section(MotionConfig)
    rig: RigConfig = section(RigConfig)
    sensor: SensorConfig = section(SensorConfig)
    imu: ImuConfig = section(ImuConfig)
    start_s: int = parameter(1_700_000_000, unit="s", minimum=1, maximum=4_000_000_000, doc="stamp of the first frame")
    exposure_topic: bool = parameter(False, doc="also write /camera/exposure")


RECORD = "simulation.yaml"
"""File with what was asked for, in every directory that the simulator writes."""

PRESETS: dict[str, dict[str, Any]] = {
    "smoke": {"motion.duration_s": 5.0, "motion.passes": 1},
    "short": {"motion.duration_s": 25.0, "motion.passes": 2},
    # 130.5 s of motion at this speed are the 185 cm of the paper's sequence.
    "full": {"motion.duration_s": 132.0, "motion.passes": 6, "motion.speed": 0.01418},
}
"""Preset name → dotted parameters that differ from the defaults."""


def make_config(preset: str, overrides: dict[str, Any] | None = None) -> SimulationConfig:
    """Return a preset's config with dotted ``overrides`` applied.

    Raises:
        SimulationError: unknown preset.
        ConfigError: unknown or invalid parameters, all at once.
    """
    if preset not in PRESETS:
        raise SimulationError(f"unknown preset '{preset}', expected one of {', '.join(PRESETS)}")
    return from_mapping(SimulationConfig, {**PRESETS[preset], **(overrides or {})})


def to_document(config: SimulationConfig) -> dict[str, Any]:
    """Return the config as plain nested values, for the record beside the bag."""
    return to_mapping(dataclasses.replace(config))
