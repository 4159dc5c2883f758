"""``vli simulate``: arguments and the run."""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import yaml
from tqdm import tqdm

from vli_common.errors import OutputError
from vli_simulation.config import PRESETS, SimulationError, make_config
from vli_simulation.scenes import SCENES
from vli_simulation.simulate import Simulation, write_recording

_FLAGS: tuple[tuple[str, str, type, str], ...] = (
    ("--duration", "motion.duration_s", float, "seconds"),
    ("--passes", "motion.passes", int, "back and forth"),
    ("--speed", "motion.speed", float, "m/s; 0 stands still"),
    ("--distance", "motion.distance", float, "camera to surface, metres"),
    ("--tremor", "motion.tremor", float, "scale of the hand's tremor; 0: none"),
    ("--sway", "motion.sway", float, "scale of the hand's slow wandering; 0: none"),
    ("--stripe-angle", "rig.stripe_angle_deg", float, "stripe in the image, degrees: 0 along rows, 90 along columns"),
    ("--lens", "rig.lens", str, "radtan, equidistant or none"),
    ("--laser-colour", "rig.laser_colour", str, "red or blue"),
    ("--exposure-long", "sensor.exposure_long_s", float, "seconds"),
    ("--exposure-short", "sensor.exposure_short_s", float, "seconds"),
    ("--encoding", "sensor.encoding", str, "jpeg, bayer, bayer-png, rgb or mono"),
    ("--quality", "sensor.quality", int, "of jpeg, 1 to 100"),
    ("--imu-noise", "imu.noise_scale", float, "scale of the IMU's noise and biases; 0: none"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``vli simulate``."""
    parser.add_argument("scene", choices=sorted(SCENES), help="what is scanned")
    parser.add_argument("--out", type=Path, required=True, help="directory to write; refused where it has content")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing directory")
    parser.add_argument("--seed", type=int, default=0, help="of everything that is random; same seed, same recording")
    parser.add_argument(
        "--preset", choices=tuple(PRESETS), default="short", help="5 s, 25 s (two passes) or 132 s (six passes, 185 cm)"
    )
    parser.add_argument("--workers", type=int, default=None, help="threads; the result does not depend on it")
    parser.add_argument("--no-rest", action="store_true", help="starts in full motion")
    parser.add_argument("--resolution", metavar="WxH", help="pixels, e.g. 640x480")
    parser.add_argument("--exposure-topic", action="store_true", help="also write /camera/exposure")
    for flag, name, kind, text in _FLAGS:
        parser.add_argument(flag, type=kind, dest=name, metavar="V", help=text)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="any parameter, e.g. sensor.speckle=0.4")


def run(args: argparse.Namespace) -> int:
    """Simulate a recording.

    Raises:
        OutputError: the directory exists and has content.
        SimulationError, ConfigError: what was asked for is impossible.
    """
    config = make_config(args.preset, _overrides(args))
    if args.seed < 0 or (args.workers is not None and args.workers < 1):
        raise SimulationError(
            f"--seed '{args.seed}' or --workers '{args.workers}' is out of range, expected at least 0 and at least 1"
        )
    _refuse_to_overwrite(args.out, args.overwrite)
    start = time.monotonic()
    simulation = Simulation(args.scene, config, args.seed)
    partial = _make_partial(args.out)
    with tqdm(total=len(simulation), unit="frame", disable=None, file=sys.stderr) as bar:
        write_recording(simulation, partial, args.workers, bar.update)
    if args.out.exists():
        shutil.rmtree(args.out)
    partial.rename(args.out)
    wall = time.monotonic() - start
    rate = len(simulation) / wall
    sys.stdout.write(f"{args.out}: {len(simulation)} frames, {simulation.path_length:.3f} m, {wall:.1f} s, {rate:.1f} frames/s\n")
    return 0


def _overrides(args: argparse.Namespace) -> dict[str, Any]:
    """Return dotted parameters from the flags and ``--set``."""
    given = {name: getattr(args, name) for _, name, _, _ in _FLAGS if getattr(args, name) is not None}
    if args.no_rest:
        given["motion.rest_s"] = 0.0
    if args.exposure_topic:
        given["exposure_topic"] = True
    if args.resolution:
        width, _, height = args.resolution.partition("x")
        given["rig.width"], given["rig.height"] = yaml.safe_load(width), yaml.safe_load(height)
    for item in args.set:
        key, _, value = item.partition("=")
        given[key] = yaml.safe_load(value)
    return given


def _refuse_to_overwrite(out: Path, overwrite: bool) -> None:
    if out.exists() and (not out.is_dir() or any(out.iterdir())) and not overwrite:
        raise OutputError(f"'{out}' exists and is not empty; choose another --out or add --overwrite")


def _make_partial(out: Path) -> Path:
    """Return the empty directory ``OUT.partial``; what was left there by an interrupted run is removed."""
    partial = out.with_name(out.name + ".partial")
    if partial.exists():
        shutil.rmtree(partial)
    partial.mkdir(parents=True)
    return partial
