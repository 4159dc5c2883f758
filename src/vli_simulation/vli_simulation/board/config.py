"""What calibration data is made of, besides what every recording is made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from vli_common.config import from_mapping, parameter, section
from vli_simulation.config import SimulationConfig

WIDE_SPREAD = 4.0
"""How much more than parts of one batch the sensors differ where they are to vary."""


@dataclass(frozen=True)
class BoardConfig:
    """The board, how it is looked at, and what the arm and the clocks do."""

    images: int = parameter(30, minimum=3, maximum=1000, doc="images, or pairs of images, in each part")
    tilt_deg: float = parameter(
        45.0, unit="degrees", minimum=0.0, maximum=65.0, doc="largest tilt of the board; zero: all views are parallel"
    )
    thickness: float = parameter(
        0.003, unit="m", minimum=0.0, maximum=0.05, doc="of the plate, which lies on a table; zero: a sheet on the table"
    )
    gloss: float = parameter(0.05, minimum=0.0, maximum=1.0, doc="strength of the highlight that the LED leaves on the print")
    shake: float = parameter(1.0, minimum=0.0, maximum=20.0, doc="scale of the hand's motion while a still image is exposed")
    excitation: float = parameter(
        1.0, minimum=0.0, maximum=3.0, doc="scale of the motion in the bag; more: a better determined IMU, more blur"
    )
    alternate: bool = parameter(True, doc="long and short exposures in turn in the bag; false: long ones only, at half the rate")
    time_offset_s: float = parameter(
        0.004, unit="s", minimum=-0.09, maximum=0.09, doc="timeshift_cam_imu: stamps of the IMU are late by this"
    )
    rest_hours: float = parameter(2.0, unit="h", minimum=0.01, maximum=24.0, doc="length of the IMU's recording at rest")
    combined: bool = parameter(False, doc="one image with board and stripe in place of a long and a short one")
    arm: bool = parameter(
        False, doc="an arm holds the sensor: combined images, poses in data.txt, and images of the stripe alone"
    )
    arm_noise_m: float = parameter(1e-4, unit="m", minimum=0.0, maximum=0.01, doc="error of the arm's position, one sigma")
    arm_noise_rad: float = parameter(5e-4, unit="rad", minimum=0.0, maximum=0.1, doc="error of the arm's rotation, one sigma")
    vary_rig: bool = parameter(False, doc="sensors of different seeds differ as much as different designs do")


@dataclass(frozen=True)
class BoardSimulationConfig(SimulationConfig):
    """Everything that decides calibration data, besides target and seed.

    Of ``motion``, the bag's length, its rest and its tremor count, and the distance that light and laser are made for.
    """

    board: BoardConfig = section(BoardConfig)


_DEFAULTS: dict[str, Any] = {"motion.duration_s": 30.0, "motion.rest_s": 1.0}


def make_board_config(overrides: dict[str, Any] | None = None) -> BoardSimulationConfig:
    """Return the config with dotted ``overrides`` applied.

    Raises:
        ConfigError: unknown or invalid parameters, all at once.
    """
    return from_mapping(BoardSimulationConfig, {**_DEFAULTS, **(overrides or {})})
