"""The calibration: for which modes it is complete, and how old it is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from vli_bringup.diagnosis.findings import Finding, Level
from vli_common.calibration import Calibration, load_calibration
from vli_common.errors import CalibrationError
from vli_common.types import Mode


def check_calibration(path: Path, imu_path: Path | None, calibration: Calibration) -> Iterator[Finding]:
    """Say which modes a calibration file is complete for, and where its sections come from."""
    missing: dict[Mode, str] = {}
    for mode in Mode:
        try:
            load_calibration(path, mode, imu_path)
        except CalibrationError as error:
            missing[mode] = "; ".join(error.problems)
    complete = [mode.value for mode in Mode if mode not in missing]
    if complete:
        yield Finding(Level.GOOD, "calibration", f"complete for --mode {', '.join(complete)}")
    if Mode.VLI_SLAM in missing:
        yield Finding(Level.WARNING if complete else Level.PROBLEM, "calibration", f"not for vli-slam: {missing[Mode.VLI_SLAM]}")
    for name in ("cam0", "laser0", "imu0"):
        provenance = (calibration.document.get(name) or {}).get("provenance")
        if isinstance(provenance, dict) and provenance.get("date"):
            yield Finding(Level.GOOD, "calibration", f"{name} is of {provenance['date']}")
