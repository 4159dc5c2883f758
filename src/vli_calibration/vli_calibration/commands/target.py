"""``vli calibrate target``: a board to print."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from vli_calibration.documents import write_atomically
from vli_calibration.target_pdf import PAGES_MM, make_sheet
from vli_calibration.targets import FORMS, parse_target
from vli_common.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("target", metavar="T", help=FORMS.replace("%", "%%"))
    parser.add_argument("--out", type=Path, required=True, metavar="F.pdf", help="file to write")
    pages = ", ".join(PAGES_MM)
    parser.add_argument("--page", metavar="P", help=f"paper: {pages} or WIDTHxHEIGHT in mm (default: the smallest of a4 to a0)")


def run(args: argparse.Namespace) -> int:
    """Draw the target and say how to check the print."""
    if args.out.suffix.lower() != ".pdf":
        raise InputError(f"'{args.out}' is no name of a PDF; expected --out F.pdf")
    target = parse_target(args.target)
    sheet = make_sheet(target, args.page)
    write_atomically(args.out, sheet.data)
    width, height = sheet.size_mm
    sys.stdout.write(
        f"{args.out}: {target.spec} on {sheet.page} ({width:g} x {height:g} mm)\n"
        f"- print at 100 % (actual size), not 'fit to page', and glue it onto something flat\n"
        f"- the ruler must measure {sheet.ruler_mm:g} mm; otherwise scale the lengths in --target by what it measures\n"
    )
    return 0
