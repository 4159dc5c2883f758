"""A finding: how bad it is, what it is about, and one line in words."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from vli_common.types import EncodedImage, ImuSample


class Level(IntEnum):
    """How bad a finding is."""

    GOOD = 0
    WARNING = 1
    """A scan will work, but worse than it could."""
    PROBLEM = 2
    """A scan will not work."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the diagnosis.

    Args:
        level: how bad.
        subject: what it is about, in one or two words.
        text: what was seen and, unless it is good, what to do.
    """

    level: Level
    subject: str
    text: str


class Check(Protocol):
    """Looks at data as they come."""

    def add(self, item: EncodedImage | ImuSample) -> None:
        """Take the next item of the source."""
        ...

    def findings(self) -> Iterable[Finding]:
        """Say what was found in all that was taken."""
        ...


_MARKS = {Level.GOOD: "ok", Level.WARNING: "warning", Level.PROBLEM: "PROBLEM"}


def to_text(findings: Iterable[Finding]) -> str:
    """Return the findings as an aligned list, the worst ones last, where a terminal shows them."""
    rows = sorted(findings, key=lambda finding: finding.level)
    width = max((len(finding.subject) for finding in rows), default=0)
    return "\n".join(f"{_MARKS[row.level]:8} {row.subject:{width}}  {row.text}" for row in rows)


def worst(findings: Iterable[Finding]) -> Level:
    """Return the level of the worst finding; GOOD where there is none."""
    return max((finding.level for finding in findings), default=Level.GOOD)
