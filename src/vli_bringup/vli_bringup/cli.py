"""The ``vli`` command: one table of subcommands, each imported only when it is asked for."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import time
from collections.abc import Sequence
from typing import NoReturn

import vli_common
from vli_common.errors import VliError

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("vli_bringup.demo", "scan the bag that comes with the project, through the node graph"),
    "run": ("vli_bringup.run", "a bag to trajectory and map, offline, as fast as the machine goes"),
    "replay": ("vli_bringup.replay", "a bag through the node graph, at the bag's pace"),
    "live": ("vli_bringup.live", "the node graph for a scanner that runs"),
    "simulate": ("vli_simulation.cli", "make a bag with truth"),
    "calibrate": ("vli_calibration.cli", "camera, laser plane, IMU: make a calibration and say what it is worth"),
    "record": ("vli_bringup.record", "what the scanner sends, to a bag"),
    "view": ("vli_bringup.view", "results, a bag or a running scan, in a browser"),
    "doctor": ("vli_bringup.doctor", "is a bag, or a live sensor, fit for a scan? say what to change"),
    "export": ("vli_bringup.export", "a map to a cloud (.ply .pcd .las .laz .e57) or a mesh (.stl .obj .glb, .ply with --mesh)"),
    "merge": ("vli_bringup.merge", "several saved maps that overlap, aligned, to one"),
    "eval": ("vli_bringup.evaluation", "compare the output of run or replay with the truth"),
}
"""Name → module with ``add_arguments(parser)`` and ``run(args) -> int``, and the line in ``vli --help``."""

EXIT_UNUSABLE = 2
_EXIT_INTERRUPTED = 130


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, like every other error of the command."""

    def error(self, message: str) -> NoReturn:
        """Leave with the message."""
        self.exit(EXIT_UNUSABLE, f"{self.prog}: {message}; see '{self.prog} --help'\n")


def make_parser(command: str | None) -> argparse.ArgumentParser:
    """Return the parser; only ``command`` knows its arguments, since knowing them means importing its module."""
    parser = _Parser(prog="vli", description="Visual-laser-inertial scanning: bags to trajectories and coloured maps.")
    parser.add_argument("--version", action="version", version=f"%(prog)s {vli_common.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=_Parser)
    for name, (module, text) in COMMANDS.items():
        subparser = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        if name == command:
            implementation = importlib.import_module(module)
            implementation.add_arguments(subparser)
            subparser.set_defaults(run=implementation.run, parser=subparser)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; return 0 done, 1 tracking never started, 2 nothing usable, 130 interrupted.

    This is the one place that turns an error into a line on stderr.
    """
    started_s = time.perf_counter()
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        command = next((item for item in arguments if not item.startswith("-")), None)
        args, unknown = make_parser(command).parse_known_args(arguments, argparse.Namespace(started_s=started_s))
        if unknown:
            args.parser.error(f"unrecognized arguments: {' '.join(unknown)}")
        code: int = args.run(args)
        sys.stdout.flush()
        return code
    except VliError as error:
        print(f"vli: {' '.join(str(error).split())}", file=sys.stderr)
        return EXIT_UNUSABLE
    except KeyboardInterrupt:
        print("vli: interrupted", file=sys.stderr)
        return _EXIT_INTERRUPTED
    except BrokenPipeError:
        # The reader of stdout has gone (`vli eval … | head`); what is still buffered must not raise again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


if __name__ == "__main__":
    sys.exit(main())
