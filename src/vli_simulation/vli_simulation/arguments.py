"""What the scenes and the board have in common on the command line."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

from vli_common.directories import NewDirectory
from vli_common.errors import ConfigError
from vli_common.yaml_text import parse_assignments
from vli_simulation.config import RECORD, SimulationError

Flag: TypeAlias = tuple[str, str, type, str]
"""A flag, the dotted parameter it sets, the type of its value, and its help."""

SENSOR_FLAGS: tuple[Flag, ...] = (
    ("--stripe-angle", "rig.stripe_angle_deg", float, "stripe in the image, degrees: 0 along rows, 90 along columns"),
    ("--lens", "rig.lens", str, "radtan, equidistant or none"),
    ("--laser-colour", "rig.laser_colour", str, "red or blue"),
    ("--exposure-long", "sensor.exposure_long_s", float, "seconds"),
    ("--exposure-short", "sensor.exposure_short_s", float, "seconds"),
    ("--encoding", "sensor.encoding", str, "jpeg, bayer, bayer-png, rgb or mono"),
    ("--quality", "sensor.quality", int, "of jpeg, 1 to 100"),
    ("--imu-noise", "imu.noise_scale", float, "scale of the IMU's noise and biases; 0: none"),
)


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Add where to write, the seed and the number of threads."""
    parser.add_argument("--out", type=Path, required=True, help="directory to write; refused where it has content")
    parser.add_argument("--overwrite", action="store_true", help="replace what the same command has written there")
    parser.add_argument("--seed", type=int, default=0, help="of everything that is random; same seed, same recording")
    parser.add_argument("--workers", type=int, default=None, help="threads; the result does not depend on it")


def add_flags(parser: argparse.ArgumentParser, flags: Sequence[Flag]) -> None:
    """Add flags that set parameters, and ``--set`` for all the others."""
    parser.add_argument("--no-rest", action="store_true", help="starts in full motion")
    parser.add_argument("--resolution", metavar="WxH", type=_resolution, help="pixels, e.g. 640x480")
    parser.add_argument("--exposure-topic", action="store_true", help="also write /camera/exposure")
    for flag, name, kind, text in flags:
        parser.add_argument(flag, type=kind, dest=name, metavar="V", help=text)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="any parameter, e.g. sensor.speckle=0.4")


def overrides(args: argparse.Namespace, flags: Sequence[Flag]) -> dict[str, Any]:
    """Return dotted parameters from ``flags`` and ``--set``.

    Raises:
        ConfigError: ``--set`` without a value, or one that is not YAML.
    """
    given = {name: getattr(args, name) for _, name, _, _ in flags if getattr(args, name) is not None}
    if args.no_rest:
        given["motion.rest_s"] = 0.0
    if args.exposure_topic:
        given["exposure_topic"] = True
    if args.resolution:
        given["rig.width"], given["rig.height"] = args.resolution
    assigned, problems = parse_assignments(args.set, "sensor.speckle=0.4")
    if problems:
        raise ConfigError(problems)
    return given | assigned


def new_directory(args: argparse.Namespace) -> NewDirectory:
    """Return the directory that :func:`add_output_arguments` asks for, made when it is entered.

    Raises:
        OutputError: the directory exists and has content, or is none.
        SimulationError: seed or number of threads is impossible.
    """
    if args.seed < 0 or (args.workers is not None and args.workers < 1):
        raise SimulationError(
            f"--seed '{args.seed}' or --workers '{args.workers}' is out of range, expected at least 0 and at least 1"
        )
    return NewDirectory(args.out, RECORD, args.overwrite)


def _resolution(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    try:
        return int(width), int(height)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}', expected WxH in pixels, e.g. 640x480") from None
