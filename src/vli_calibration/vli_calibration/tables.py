"""Tables of figures, the same on the terminal and in a report: names to the left, figures to the right."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

_FIGURE = re.compile(
    r"[-+−±≤≥<>~≈]?\s*[\d.,]+(?:e[-+]?\d+)?\s*(?:%|°|px|m|mm|µm|s|ms|Hz)?(?:\s*(?:±|to|of|/|–|\.\.)\s*.*)?|[-–—]|"
)
"""What is set to the right: a number with its unit, an interval, a dash for none."""


def cell_text(value: object) -> str:
    """Return what a cell shows: floats with four digits, None as a dash, the rest as it is."""
    if value is None:
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return f"{value:.4g}" if math.isfinite(value) else "–"
    return str(value)


def is_figures(cells: Sequence[str]) -> bool:
    """Return True for a column of figures, to be set to the right."""
    return any(any(map(str.isdigit, cell)) for cell in cells) and all(_FIGURE.fullmatch(cell.strip()) for cell in cells)


def text_table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a table for the terminal, without a final newline."""
    cells = [[cell_text(value) for value in row] for row in rows]
    columns = list(zip(*cells, strict=True)) if cells else [()] * len(header)
    widths = [max(map(len, (name, *column))) for name, column in zip(header, columns, strict=True)]
    right = [is_figures(column) for column in columns]

    def line(texts: Sequence[str]) -> str:
        padded = (
            text.rjust(width) if to_right else text.ljust(width)
            for text, width, to_right in zip(texts, widths, right, strict=True)
        )
        return "  ".join(padded).rstrip()

    return "\n".join([line(header), "  ".join("-" * width for width in widths), *(line(row) for row in cells)])
