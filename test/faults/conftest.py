"""The recording that the faults are put into, and what it comes to without any."""

from __future__ import annotations

import numpy as np
import pytest
from runs import Run, Surface, run
from streams import Span, images, there_and_back, until

from vli_bringup.tum import read_tum
from vli_common import ply
from vli_common.calibration import load_calibration
from vli_driver.bag import BagReader

REST = Span(0.0, 1.0)
"""At rest at the start of the recording."""


@pytest.fixture(scope="session")
def demo(repository):
    return repository / "bags" / "demo"


@pytest.fixture(scope="session")
def calibration(demo):
    return load_calibration(demo / "calibration.yaml")


@pytest.fixture(scope="session")
def recording(demo):
    """Return seven seconds over a keyboard: a second at rest, then 11 cm."""
    return list(BagReader(demo / "bag"))


@pytest.fixture(scope="session")
def truth(demo):
    trajectory = read_tum(demo / "truth.tum")
    poses = dict(zip(trajectory.stamps_ns.tolist(), trajectory.poses, strict=True))
    return lambda stamp_ns: poses[stamp_ns]


@pytest.fixture(scope="session")
def first_part(recording):
    """Return its first four seconds, for faults whose end is soon seen."""
    return until(recording, 4.0)


@pytest.fixture(scope="session")
def revisit(recording):
    """Return a scan over the keys and back over the same keys; it rests in the middle, after 6 s, for 2 s."""
    return there_and_back(recording, REST)


@pytest.fixture(scope="session")
def truth_of_revisit(recording, revisit, truth):
    first_ns = images(recording)[0].stamp_ns
    offset_ns = images(revisit)[-1].stamp_ns - images(recording)[::2][-1].stamp_ns
    return lambda stamp_ns: truth(first_ns + abs(stamp_ns - offset_ns - first_ns))


@pytest.fixture(scope="session")
def surface(demo):
    return Surface(ply.read_cloud(demo / "seen.ply").points.astype(np.float64))


@pytest.fixture(scope="session")
def clean(recording, calibration) -> Run:
    """Return the run of the recording as it is."""
    return run(recording, calibration)


@pytest.fixture(scope="session")
def clean_first_part(first_part, calibration) -> Run:
    return run(first_part, calibration)


@pytest.fixture(scope="session")
def scan(calibration):
    """Return a function that runs a stream."""

    def scan(stream, **options):
        result = run(stream, calibration, **options)
        assert result.is_finite()
        return result

    return scan
