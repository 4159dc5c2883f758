"""Stamps as decimal text, without the rounding of a float."""

from __future__ import annotations

from vli_common.types import NANOSECONDS


def seconds_text(stamp_ns: int) -> str:
    """Return integer nanoseconds as seconds with nine decimals."""
    sign, stamp_ns = ("-", -stamp_ns) if stamp_ns < 0 else ("", stamp_ns)
    return f"{sign}{stamp_ns // NANOSECONDS}.{stamp_ns % NANOSECONDS:09d}"
