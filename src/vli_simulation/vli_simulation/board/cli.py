"""``vli simulate board``: arguments and the run."""

from __future__ import annotations

import argparse
import sys
import time

from tqdm import tqdm

from vli_calibration.targets import FORMS, parse_target
from vli_simulation.arguments import SENSOR_FLAGS, Flag, add_flags, add_output_arguments, new_directory, overrides
from vli_simulation.board.config import make_board_config
from vli_simulation.board.parts import PARTS, write_truth
from vli_simulation.board.simulate import BoardSimulation

HELP = "make images and bags of a calibration board, with truth"
DESCRIPTION = """Make what 'vli calibrate' needs, with truth: camera/ (images of the board, laser off), laser/ (pairs
NNN_long.png and NNN_short.png, the laser on in the short one), bag (the sensor moving before the board), imu_rest (a bag of the
IMU at rest, for hours). calibration.yaml is the instrument as it is, nominal.yaml as it was drawn; truth.yaml has also the
poses of the board."""

_FLAGS: tuple[Flag, ...] = (
    ("--images", "board.images", int, "images (or pairs) in camera/ and in laser/; default 30"),
    ("--tilt", "board.tilt_deg", float, "largest tilt of the board, degrees; 0: all views parallel"),
    ("--duration", "motion.duration_s", float, "of the moving bag, seconds; default 30"),
    ("--time-offset", "board.time_offset_s", float, "t_imu = t_cam + V, seconds: stamps of the IMU are late by this"),
    ("--rest-hours", "board.rest_hours", float, "of the IMU at rest; default 2"),
    ("--distance", "motion.distance", float, "that light and laser are made for, metres"),
    ("--tremor", "motion.tremor", float, "scale of the hand's tremor in the bag; 0: none"),
    *SENSOR_FLAGS,
)
_SWITCHES = (
    ("--combined", "board.combined", True, "laser/ has one image with board and stripe, NNN.png, in place of pairs"),
    ("--arm", "board.arm", True, "an arm holds the sensor: as --combined, with data.txt and images of the stripe alone"),
    ("--long-only", "board.alternate", False, "the moving bag has long exposures only, at half the rate"),
    ("--vary-rig", "board.vary_rig", True, "sensors of different seeds differ as different designs do"),
)
_DEFAULT_PARTS = ("camera", "laser", "bag")
_DEFAULT_TARGET = "chessboard:9x6:0.005"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``vli simulate board``."""
    add_output_arguments(parser)
    parser.add_argument("--target", default=_DEFAULT_TARGET, metavar="T", help=f"{FORMS}; default {_DEFAULT_TARGET}")
    parser.add_argument(
        "--parts",
        nargs="+",
        choices=tuple(PARTS),
        default=list(_DEFAULT_PARTS),
        help=f"what to make; default {' '.join(_DEFAULT_PARTS)}",
    )
    for flag, _, _, text in _SWITCHES:
        parser.add_argument(flag, action="store_true", help=text)
    add_flags(parser, _FLAGS)


def run(args: argparse.Namespace) -> int:
    """Make calibration data.

    Raises:
        OutputError: the directory exists and has content.
        SimulationError, ConfigError, InputError: what was asked for is impossible.
    """
    switched = {name: value for flag, name, value, _ in _SWITCHES if getattr(args, flag[2:].replace("-", "_"))}
    config = make_board_config({**switched, **overrides(args, _FLAGS)})
    target = parse_target(args.target)
    directory = new_directory(args)
    start = time.monotonic()
    simulation = BoardSimulation(target, config, args.seed)
    parts = {name: PARTS[name](simulation) for name in PARTS if name in args.parts}
    truth = []
    with directory as partial:
        for name, part in parts.items():
            with tqdm(total=len(part), desc=name, disable=None, file=sys.stderr) as bar:
                truth.append(part.write(partial, args.workers, bar.update))
        write_truth(simulation, truth, partial)
    made = ", ".join(f"{name} {len(part)}" for name, part in parts.items())
    sys.stdout.write(f"{args.out}: {target.spec}, {made}; {time.monotonic() - start:.1f} s\n")
    return 0
