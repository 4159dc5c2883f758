"""Errors that a user can do something about.

Libraries raise them, only ``main()`` prints them: one line that says what failed, the offending value in quotes, what would
be valid, and the next command.
"""

from __future__ import annotations

from collections.abc import Sequence

_LONGEST = 400


class VliError(Exception):
    """Base of every error that the project raises on purpose."""


class CalibrationError(VliError):
    """The calibration file is missing, malformed, or describes an impossible sensor.

    Args:
        source: file or topic that the calibration came from.
        problems: one sentence each; all problems found, not only the first.
    """

    def __init__(self, source: str, problems: Sequence[str]) -> None:
        self.source = source
        self.problems = tuple(problems)
        super().__init__(f"calibration '{source}': " + "; ".join(self.problems))


class ConfigError(VliError):
    """A parameter has an unknown name or a value out of range.

    Args:
        problems: one sentence each; all problems found, not only the first.
    """

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(self.problems))


class InputError(VliError):
    """The input data (bag, topic, image) cannot be used."""


class MessageError(VliError):
    """A message from a topic is malformed; the receiver drops and counts it.

    Args:
        text: may quote the message; control characters and whatever is too long for a log are left out.
    """

    def __init__(self, text: str) -> None:
        shown = "".join(character if character.isprintable() else " " for character in text[:_LONGEST])
        super().__init__(shown + ("…" if len(text) > _LONGEST else ""))


class OutputError(VliError):
    """A result cannot be written."""
