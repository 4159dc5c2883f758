"""When the monitor of the laser plane speaks: the plane of the calibration is turned or shifted, the images stay as they are.

    python test/perf/bench_laser_monitor.py [RECORDING ...] [--duration 25]

RECORDING (default ``../shared/data/keyboard_short``) holds ``bag`` and ``calibration.yaml``. Images are worked on once; for each
fault the stripes are triangulated anew and the back end runs again (`vli-odom`). A cell gives the seconds from the first pose to
the warning and its sign: *a* along the stripe, *r* with range, *s* scale; – where there is none. The first row is the plane as
it is: every warning there is a false one.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vli_backend.backend import BackEnd
from vli_bringup.pipeline import Pipeline, Stages
from vli_bringup.settings import Settings, load_settings
from vli_bringup.warm_up import warm_up
from vli_common.calibration import Calibration, LaserCalibration, load_calibration
from vli_common.geometry import so3_exp
from vli_common.types import NANOSECONDS, BackEndOutput, FrontEndOutput, LaserScan, Mode
from vli_driver.bag import BagReader, BagTopics

DATA = Path(__file__).resolve().parents[3] / "shared/data/keyboard_short"
Event = LaserScan | FrontEndOutput
SIGNS = {"along the stripe": "a", "twice the range": "r", "the IMU says": "s"}


class RecordingBackEnd(BackEnd):
    """Keeps what it is given."""

    events: list[Event]

    def add_scan(self, scan: LaserScan) -> None:
        """See :meth:`BackEnd.add_scan`."""
        self.events.append(scan)
        super().add_scan(scan)

    def add_frame(self, frame: FrontEndOutput) -> BackEndOutput:
        """See :meth:`BackEnd.add_frame`."""
        self.events.append(frame)
        return super().add_frame(frame)


@dataclass(frozen=True)
class Fault:
    """A plane that is not where the calibration has it: turned about the stripe or along it (degrees), shifted (share of d)."""

    about: float = 0.0
    along: float = 0.0
    shift: float = 0.0

    def applied(self, laser: LaserCalibration) -> LaserCalibration:
        """Return the calibration's plane with the fault; turned about the camera, so that d stays."""
        stripe = np.array([-laser.normal[1], laser.normal[0], 0.0]) / np.linalg.norm(laser.normal[:2])
        across = np.cross(laser.normal, stripe)
        turn = so3_exp(np.radians(self.about) * stripe + np.radians(self.along) * across)
        return replace(laser, normal=turn @ laser.normal, d=laser.d * (1.0 + self.shift))

    def __str__(self) -> str:
        parts = (("about the stripe {:+.1f}°", self.about), ("along it {:+.1f}°", self.along), ("d {:+.0%}", self.shift))
        return ", ".join(text.format(value) for text, value in parts if value) or "none"


FAULTS = [
    Fault(),
    *(Fault(about=angle) for angle in (-0.3, 0.3, -0.5, 0.5, -1.0, 1.0)),
    *(Fault(along=angle) for angle in (-0.3, 0.3, 0.5, 1.0)),
    *(Fault(shift=share) for share in (-0.03, 0.03, 0.06)),
]


def record(recording: Path, calibration: Calibration, settings: Settings, duration_s: float) -> list[Event]:
    """Return what the back end was given, with the calibration as it is."""
    stages = Stages.create(calibration, settings, Mode.VLI_ODOM)
    back_end = RecordingBackEnd(calibration, settings.backend, Mode.VLI_ODOM)
    back_end.events = []
    stages.back_end = back_end
    pipeline = Pipeline(stages, Mode.VLI_ODOM)
    for item in BagReader(recording / "bag", BagTopics(), 0.0, duration_s):
        pipeline.push(item)
    pipeline.flush()
    return back_end.events


def triangulated(scan: LaserScan, laser: LaserCalibration) -> LaserScan:
    """Return the scan with its rays cut by another plane, eq. (1)."""
    if not len(scan):
        return scan
    rays = scan.points / scan.points[:, 2:]
    depth = -laser.d / (rays @ laser.normal)
    return replace(scan, points=depth[:, None] * rays)


def hints(
    events: list[Event], calibration: Calibration, laser: LaserCalibration, settings: Settings
) -> Iterator[tuple[float, str]]:
    """Yield, frame by frame, seconds since the first pose and the sign of the warning, if there is one."""
    back_end = BackEnd(replace(calibration, laser=laser), settings.backend, Mode.VLI_ODOM)
    first_ns = None
    for event in events:
        if isinstance(event, LaserScan):
            back_end.add_scan(triangulated(event, laser))
            continue
        output = back_end.add_frame(event)
        first_ns = output.stamp_ns if first_ns is None and output.pose is not None else first_ns
        if first_ns is not None:
            sign = next((sign for text, sign in SIGNS.items() if text in output.reason), "")
            yield (output.stamp_ns - first_ns) / NANOSECONDS, sign


def cell(events: list[Event], calibration: Calibration, laser: LaserCalibration, settings: Settings) -> str:
    """Return when the back end warned first, and by which sign; whether it took that back by the end."""
    signs = list(hints(events, calibration, laser, settings))
    first = next((f"{sign} {seconds:.1f} s" for seconds, sign in signs if sign), "")
    return first + (", then none" if first and not signs[-1][1] else "") or "–"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, nargs="*", default=[DATA])
    parser.add_argument("--duration", type=float, default=25.0, help="seconds from the start of each recording")
    args = parser.parse_args()
    warm_up()
    settings = load_settings(None, ())
    calibrations = [load_calibration(path / "calibration.yaml") for path in args.recordings]
    recorded = [record(p, c, settings, args.duration) for p, c in zip(args.recordings, calibrations, strict=True)]
    print("| plane | " + " | ".join(path.name for path in args.recordings) + " |")
    print("|---|" + "---|" * len(args.recordings))
    for fault in FAULTS:
        cells = [
            cell(events, c, fault.applied(c.laser), settings)
            for events, c in zip(recorded, calibrations, strict=True)
            if c.laser is not None
        ]
        print(f"| {fault} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
