"""The rendered keyboard that several tests look at."""

from __future__ import annotations

import pytest
from flat_scene import SMALL

from vli_simulation.config import make_config
from vli_simulation.simulate import Simulation


@pytest.fixture(scope="session")
def keyboard() -> Simulation:
    """Return a small keyboard recording, not yet rendered."""
    return Simulation("keyboard", make_config("smoke", {**SMALL, "motion.rest_s": 0.5, "motion.duration_s": 2.0}), 3)
