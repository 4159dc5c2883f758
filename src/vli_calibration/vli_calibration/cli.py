"""``vli calibrate``: one table of subcommands."""

from __future__ import annotations

import argparse
import importlib

COMMANDS: dict[str, tuple[str, str]] = {
    "camera": ("camera", "intrinsics and lens distortion from images of a flat target"),
    "check": ("check", "how far to trust a calibration, from the stripe on a flat target"),
    "imu": ("imu", "noise densities and random walks of an IMU from hours at rest"),
    "imu-camera": ("imu_camera", "rotation, translation and time offset between camera and IMU from a moving board"),
    "laser": ("laser", "the laser plane from images of a flat target with the stripe on it"),
    "target": ("target", "a target as PDF at true scale, with a ruler on it"),
}
"""Name → module in :mod:`vli_calibration.commands` with ``add_arguments(parser)`` and ``run(args) -> int``, and its help."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the subcommands, each with its own arguments."""
    commands = parser.add_subparsers(dest="calibrate", metavar="WHAT", required=True, parser_class=type(parser))
    for name, (module, text) in COMMANDS.items():
        subparser = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        importlib.import_module(f"vli_calibration.commands.{module}").add_arguments(subparser)


def run(args: argparse.Namespace) -> int:
    """Run the subcommand; return its exit code."""
    module, _ = COMMANDS[args.calibrate]
    code: int = importlib.import_module(f"vli_calibration.commands.{module}").run(args)
    return code
