"""``vli merge``: several saved maps that overlap to one."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

from vli_common.errors import InputError, OutputError
from vli_mapping.allocation import Allocate, on_disk
from vli_mapping.map_file import SUFFIX, load_map, save_map
from vli_mapping.merging import merge_maps
from vli_mapping.snapshot import Snapshot
from vli_mapping.store import check_place


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``vli merge``."""
    parser.add_argument(
        "maps", metavar="MAP", type=Path, nargs="+", help=f"results of 'vli run', or {SUFFIX} files; the first is the frame"
    )
    parser.add_argument("--out", metavar="MAP", type=Path, required=True, help=f"file to write ({SUFFIX}), for 'vli export'")


def run(args: argparse.Namespace) -> int:
    """Align and join; return 0.

    Raises:
        VliError: a map cannot be read, or does not overlap with those before it, or the result cannot be written.
    """
    if len(args.maps) < 2:
        raise InputError(f"'{args.maps[0]}' is one map, expected two or more to merge")
    if args.out.suffix != SUFFIX:
        raise OutputError(
            f"'{args.out}' ends in '{args.out.suffix}', expected '{SUFFIX}'; 'vli export' makes other formats of it"
        )
    check_place(args.out)
    allocate = on_disk(args.out.absolute().parent)
    merged, registrations = merge_maps((_load(path, allocate) for path in args.maps), allocate=allocate)
    save_map(args.out, merged)
    for path, found in zip(args.maps[1:], registrations, strict=True):
        looks = "plain" if math.isnan(found.likeness) else f"alike to {found.likeness:.2f}"
        shape = f"{100 * found.shape:.0f} % of the overlap of the same shape, {looks}"
        sys.stdout.write(f"'{path}': {shape}, {1e3 * found.rms_m:.3f} mm RMS point to plane\n")
    sys.stdout.write(f"{len(merged)} points in '{args.out}'\n")
    return 0


def _load(path: Path, allocate: Allocate) -> Snapshot:
    snapshot = load_map(path / f"map{SUFFIX}" if path.is_dir() else path, allocate)
    if not len(snapshot):
        raise InputError(f"map '{path}' is empty, there is nothing to merge")
    return snapshot
