"""``vli simulate``: a scene that is scanned, or a board for calibration; arguments and the run."""

from __future__ import annotations

import argparse
import sys
import time

from tqdm import tqdm

from vli_simulation.arguments import SENSOR_FLAGS, Flag, add_flags, add_output_arguments, new_directory, overrides
from vli_simulation.board import cli as board
from vli_simulation.config import PRESETS, make_config
from vli_simulation.scenes import SCENES
from vli_simulation.simulate import Simulation, write_recording

_FLAGS: tuple[Flag, ...] = (
    ("--duration", "motion.duration_s", float, "seconds"),
    ("--passes", "motion.passes", int, "back and forth"),
    ("--speed", "motion.speed", float, "m/s; 0 stands still"),
    ("--distance", "motion.distance", float, "camera to surface, metres"),
    ("--tremor", "motion.tremor", float, "scale of the hand's tremor; 0: none"),
    ("--sway", "motion.sway", float, "scale of the hand's slow wandering; 0: none"),
    *SENSOR_FLAGS,
)
_BOARD = "board"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``vli simulate``: one subcommand a scene, and the board."""
    parser.epilog = "Each has its own arguments: 'vli simulate keyboard --help', 'vli simulate board --help'."
    commands = parser.add_subparsers(dest="scene", metavar="SCENE", required=True, parser_class=type(parser))
    for name in sorted(SCENES):
        scene = commands.add_parser(name, help=f"scan a {name}", description=f"Make a bag of scanning a {name}, with truth.")
        _add_scene_arguments(scene)
    board.add_arguments(commands.add_parser(_BOARD, help=board.HELP, description=board.DESCRIPTION))


def run(args: argparse.Namespace) -> int:
    """Simulate a recording, or calibration data.

    Raises:
        OutputError: the directory exists and has content.
        SimulationError, ConfigError, InputError: what was asked for is impossible.
    """
    return board.run(args) if args.scene == _BOARD else _run_scene(args)


def _add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    add_output_arguments(parser)
    parser.add_argument(
        "--preset", choices=tuple(PRESETS), default="short", help="5 s, 25 s (two passes) or 132 s (six passes, 185 cm)"
    )
    add_flags(parser, _FLAGS)


def _run_scene(args: argparse.Namespace) -> int:
    config = make_config(args.preset, overrides(args, _FLAGS))
    directory = new_directory(args)
    start = time.monotonic()
    simulation = Simulation(args.scene, config, args.seed)
    with directory as partial, tqdm(total=len(simulation), unit="frame", disable=None, file=sys.stderr) as bar:
        write_recording(simulation, partial, args.workers, bar.update)
    wall = time.monotonic() - start
    rate = len(simulation) / wall
    sys.stdout.write(f"{args.out}: {len(simulation)} frames, {simulation.path_length:.3f} m, {wall:.1f} s, {rate:.1f} frames/s\n")
    return 0
