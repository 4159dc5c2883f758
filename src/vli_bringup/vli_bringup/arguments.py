"""Arguments that ``vli run``, ``vli replay`` and ``vli doctor`` share."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from vli_bringup.graph import AUTOSAVE_S
from vli_bringup.settings import Settings, load_settings
from vli_common.types import Mode
from vli_driver.bag import BagTopics
from vli_driver.config import DriverConfig
from vli_mapping.config import AS_SEEN, COMPENSATED

_TOPICS = {"image": "image_topic", "imu": "imu_topic", "camera_info": "camera_info_topic", "exposure": "exposure_topic"}
"""Name after ``--topic`` → parameter of the driver."""


def add_scan_arguments(parser: argparse.ArgumentParser) -> None:
    """Add bag, calibration, output, mode, parameters and the choice of topics and time."""
    parser.add_argument("bag", metavar="BAG", type=Path, help="rosbag2 directory or bare .mcap")
    add_result_arguments(parser)
    add_source_arguments(parser)


def add_result_arguments(parser: argparse.ArgumentParser) -> None:
    """Add calibration, output and mode."""
    parser.add_argument("--calib", metavar="C", type=Path, required=True, help="calibration file")
    parser.add_argument("--out", metavar="DIR", type=Path, help="results (default: results/STAMP, and the link results/latest)")
    parser.add_argument("--overwrite", action="store_true", help="replace the results in DIR")
    modes = [mode.value for mode in Mode]
    parser.add_argument(
        "--mode", choices=modes, default=modes[0], help="all | no window-to-map | no laser | no IMU (default: %(default)s)"
    )


def add_source_arguments(parser: argparse.ArgumentParser) -> None:
    """Add Kalibr's IMU file, parameters, and the choice of topics and time."""
    add_parameter_arguments(parser)
    parser.add_argument("--start", metavar="S", type=_seconds, default=0.0, help="skip the first S seconds")
    parser.add_argument("--duration", metavar="D", type=duration, help="stop after D seconds")
    add_topic_argument(parser)


def add_parameter_arguments(parser: argparse.ArgumentParser) -> None:
    """Add Kalibr's IMU file and parameters."""
    parser.add_argument("--imu-calib", metavar="F", type=Path, help="Kalibr's separate IMU file")
    parser.add_argument(
        "--colour", choices=(COMPENSATED, AS_SEEN), help="of the map: without the light on board (default), or as seen"
    )
    parser.add_argument("--config", metavar="F", type=Path, help="parameters, in the form of config/vli.yaml")
    parser.add_argument("--set", metavar="STAGE.KEY=VALUE", action="append", default=[], help="one parameter; may be repeated")


def add_autosave_argument(parser: argparse.ArgumentParser) -> None:
    """Add how often the graph saves its map by itself."""
    parser.add_argument(
        "--autosave",
        metavar="S",
        type=_seconds,
        default=AUTOSAVE_S,
        help="save map and path every S seconds, for what crashes; 0: never (default: %(default)g)",
    )


def add_topic_argument(parser: argparse.ArgumentParser) -> None:
    """Add the choice of topics."""
    parser.add_argument(
        "--topic", metavar="NAME=/TOPIC", type=_topic, action="append", default=[], help=f"NAME is one of {', '.join(_TOPICS)}"
    )


def source_settings(args: argparse.Namespace) -> Settings:
    """Return the settings that ``--config``, ``--set``, ``--colour`` and ``--topic`` ask for, the later ones first in rank.

    Raises:
        ConfigError: unknown names or invalid values, all of them at once.
    """
    colour = [f"mapping.colour={args.colour}"] if args.colour else []
    return load_settings(args.config, [*args.set, *colour, *_topic_settings(args)])


def chosen_topics(args: argparse.Namespace) -> DriverConfig:
    """Return the names that ``--topic`` gives, for commands that have no other parameters."""
    return load_settings(None, _topic_settings(args)).driver


def _topic_settings(args: argparse.Namespace) -> list[str]:
    return [f"driver.{_TOPICS[name]}={topic}" for name, topic in args.topic]


def bag_topics(settings: Settings, mode: Mode) -> BagTopics:
    """Return the topics to read from a bag."""
    driver = settings.driver
    return BagTopics(driver.image_topic, driver.imu_topic, driver.camera_info_topic, driver.exposure_topic, mode.uses_imu)


def number(text: str) -> float:
    """Return the number, NaN for what is none: the caller says what it expects."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _seconds(text: str) -> float:
    value = number(text)
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"'{text}', expected seconds, 0 or more")
    return value


def duration(text: str) -> float:
    """Return seconds, more than zero; for ``type`` of an argument."""
    value = number(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"'{text}', expected seconds, more than 0")
    return value


def _topic(text: str) -> tuple[str, str]:
    name, _, topic = text.partition("=")
    if name not in _TOPICS or not topic.startswith("/"):
        raise argparse.ArgumentTypeError(f"'{text}', expected one of {', '.join(f'{key}=/name' for key in _TOPICS)}")
    return name, topic
