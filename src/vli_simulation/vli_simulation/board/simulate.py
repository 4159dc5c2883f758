"""The instrument, the board before it, and everything about both that is the same in all parts of the calibration data."""

from __future__ import annotations

import dataclasses

import numpy as np

from vli_calibration.targets import Target
from vli_common.types import NANOSECONDS
from vli_simulation.board.config import WIDE_SPREAD, BoardSimulationConfig
from vli_simulation.board.render import BoardRenderer, Exposures
from vli_simulation.board.surface import make_surface
from vli_simulation.board.views import ViewPlanner
from vli_simulation.render import NOMINAL_LONG_S, NOMINAL_SHORT_S, View
from vli_simulation.rig import Rig, make_rig
from vli_simulation.sensor import Sensor

_PEAK_GREY = 420.0
_LUMINANCE = np.array([0.114, 0.587, 0.299])
"""Of blue, green and red, as a colour becomes grey."""
_SHORTEST_S, _LONGEST_SHORT_S = 2e-5, 8e-3


class BoardSimulation:
    """A sensor of a seed before a board; what is rendered depends on seed and place in its part only, not on the other parts.

    Raises:
        SimulationError: the board is too large, or its squares are too small, for the instrument's range.
    """

    def __init__(self, target: Target, config: BoardSimulationConfig, seed: int) -> None:
        self.target, self.config, self.seed = target, config, seed
        self.rig = _rig(config, seed)
        self.drawing: Rig = make_rig(config, seed, 0.0)
        """The instrument as it was designed, without misalignments."""
        self.planner = ViewPlanner(target, self.rig, np.deg2rad(config.board.tilt_deg))
        self.reach = self.planner.reach
        thickness = 0.0 if config.board.arm else config.board.thickness
        finest = 0.4 * self.reach[0] / self.rig.camera.focal_px
        surface = make_surface(target, thickness, config.board.gloss, finest)
        self.renderer = BoardRenderer(surface, self.rig, config, seed)
        self.sensor = Sensor(config.sensor, config.rig.height, config.rig.width, seed)

    @property
    def start_ns(self) -> int:
        """Stamp of the first frame of the bag."""
        return self.config.start_s * NANOSECONDS

    def exposures(self, view: View, white_grey: float, longest_s: float) -> Exposures:
        """Return exposures as a person, or a driver, would set them.

        Args:
            view: of the board.
            white_grey: grey level that paper is to have in the long exposure.
            longest_s: of the long exposure.
        """
        white, peak = self.renderer.brightness(view)
        if self.config.sensor.encoding == "mono":
            peak *= float(self.rig.laser.response @ _LUMINANCE)
        return Exposures(
            float(np.clip(NOMINAL_LONG_S * white_grey / max(white, 1e-6), _SHORTEST_S, longest_s)),
            float(np.clip(NOMINAL_SHORT_S * _PEAK_GREY / max(peak, 1e-6), _SHORTEST_S, _LONGEST_SHORT_S)),
        )


def _rig(config: BoardSimulationConfig, seed: int) -> Rig:
    """Return the instrument of the seed, its clocks ``time_offset_s`` apart."""
    rig = make_rig(config, seed, WIDE_SPREAD if config.board.vary_rig else 1.0)
    cam0 = {**rig.document["cam0"], "timeshift_cam_imu": config.board.time_offset_s}
    return dataclasses.replace(rig, document={**rig.document, "cam0": cam0})
