"""The scenes that can be scanned, by name; a further one is one line here."""

from __future__ import annotations

from collections.abc import Callable

from vli_simulation.config import SimulationError
from vli_simulation.scenes.keyboard import make_keyboard
from vli_simulation.scenes.part import make_part
from vli_simulation.scenes.pipe import make_pipe
from vli_simulation.scenes.plain import make_bar, make_plate
from vli_simulation.scenes.scene import Scene

SCENES: dict[str, Callable[[int], Scene]] = {
    "keyboard": make_keyboard,
    "pipe": make_pipe,
    "part": make_part,
    "plate": make_plate,
    "bar": make_bar,
}
"""Scene name → function that makes it from a seed."""


def make_scene(name: str, seed: int) -> Scene:
    """Return a scene; the same seed gives the same scene whatever the motion.

    Raises:
        SimulationError: there is no such scene.
    """
    if name not in SCENES:
        raise SimulationError(f"unknown scene '{name}', expected one of {', '.join(SCENES)}")
    return SCENES[name](seed)
