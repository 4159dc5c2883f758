"""Calibration files, section by section: what one command finds takes its place, everything else stays as it was."""

from __future__ import annotations

import contextlib
import copy
import os
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from vli_common.calibration import check_document, load_document, to_yaml
from vli_common.errors import OutputError

_DATE = "date"


def read_document(path: Path) -> dict[str, Any]:
    """Return a calibration file as it stands, all keys, complete or not.

    Raises:
        CalibrationError: no such file, or not YAML with sections.
    """
    return load_document(path)


def check_target_file(path: Path, base: Path | None = None) -> None:
    """Raise, before anything is computed, where ``path`` could not be written; arguments as in :func:`write_document`.

    Raises:
        CalibrationError: what ``path`` holds, and would be merged into, is no calibration.
        OutputError: it is a directory.
    """
    if path.is_dir():
        raise OutputError(f"'{path}' is a directory, expected the calibration file to write, such as '{path / 'scanner.yaml'}'")
    if base is None and path.exists():
        read_document(path)


def merged(
    document: Mapping[str, Any],
    section: str,
    values: Mapping[str, Any],
    provenance: Mapping[str, Any],
    part: str | None = None,
) -> dict[str, Any]:
    """Return the document with the keys of one section replaced or added, and where they come from.

    Args:
        document: others' sections and keys are kept, Kalibr's too.
        section: ``cam0``, ``imu0`` or ``laser0``.
        values: keys of the section.
        provenance: command, images, residuals, intervals; ``date`` (UTC) is added.
        part: where two commands write one section, the name of the second one's record within ``provenance``.
    """
    out: dict[str, Any] = copy.deepcopy(dict(document))
    whole = dict(out.get(section) or {})
    record = {_DATE: datetime.now(UTC).isoformat(timespec="seconds"), **provenance}
    before = whole.pop("provenance", None)
    before = before if isinstance(before, dict) else {}
    records = before | {part: record} if part else record | {key: value for key, value in before.items() if _is_part(value)}
    out[section] = {**whole, **values, "provenance": records}
    return out


def save_document(path: Path, document: Mapping[str, Any]) -> None:
    """Validate and write a calibration file; what was there before is there until the new one is complete.

    Raises:
        CalibrationError: a section is impossible; nothing is written.
        OutputError: the file cannot be written.
    """
    check_document(dict(document), str(path))
    write_atomically(path, to_yaml(dict(document)).encode())


def write_document(
    path: Path,
    section: str,
    values: Mapping[str, Any],
    provenance: Mapping[str, Any],
    base: Path | None = None,
    part: str | None = None,
) -> None:
    """Merge a section into the calibration ``base`` and write it to ``path``; arguments as in :func:`merged`.

    Args:
        path: of the file to write; without ``base``, what it holds already is merged into.
        section, values, provenance, part: see :func:`merged`.
        base: calibration to start from.

    Raises:
        CalibrationError: the file to start from is not YAML, or the result is impossible; nothing is written.
        OutputError: the file cannot be written.
    """
    source = base if base is not None else path
    document = read_document(source) if base is not None or path.exists() else {}
    save_document(path, merged(document, section, values, provenance, part))


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file by way of ``.NAME.partial`` beside it; its directory is made.

    Raises:
        OutputError: it cannot be written; nothing is left behind.
    """
    partial = path.with_name(f".{path.name}.partial-{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(data)
        partial.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise OutputError(f"'{path}' cannot be written ({error.strerror}); choose another place") from error


def _is_part(value: Any) -> bool:
    return isinstance(value, dict) and _DATE in value
