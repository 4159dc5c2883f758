"""Compile the kernels of this package before the first frame."""

from __future__ import annotations

from vli_simulation.config import make_config
from vli_simulation.simulate import Simulation


def warm_up() -> None:
    """Render a long and a short frame of a small, moving camera; fast where the compiled code is in numba's cache."""
    small = {"rig.width": 96, "rig.height": 72, "motion.duration_s": 0.2, "motion.rest_s": 0.0, "sensor.exposure_short_s": 0.005}
    # The pipe is the scene whose relief is made by a kernel too.
    simulation = Simulation("pipe", make_config("smoke", small), 0)
    for index in range(2):
        simulation.frame(index)
