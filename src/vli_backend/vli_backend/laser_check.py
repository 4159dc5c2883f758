"""The monitor of the laser plane, fed with what the back end has anyway; without a laser it does nothing."""

from __future__ import annotations

from vli_backend.config import BackEndConfig
from vli_backend.inertial_scale import InertialScale
from vli_backend.laser_monitor import LaserPlaneMonitor
from vli_backend.plane_residuals import PlaneResiduals
from vli_common.calibration import Calibration
from vli_common.types import FrontEndOutput, Mode, PoseEstimate


class LaserCheck:
    """Feeds :class:`LaserPlaneMonitor` from frames and windows; what it knows lasts over losses.

    Args:
        calibration: camera, IMU, laser.
        config: parameters.
        mode: which sensors take part.
    """

    def __init__(self, calibration: Calibration, config: BackEndConfig, mode: Mode) -> None:
        laser = calibration.laser
        self._monitor = LaserPlaneMonitor(laser) if laser is not None and mode.uses_laser and config.laser_check else None
        self._scale: InertialScale | None = None
        if self._monitor is not None and mode.uses_imu and calibration.T_cam_imu is not None:
            self._scale = InertialScale.of_scene(calibration, config)
        self._last: PlaneResiduals | None = None

    @property
    def hint(self) -> str:
        """What is wrong with the laser plane, in words; empty where nothing is."""
        return self._monitor.hint if self._monitor is not None else ""

    def add_frame(self, frame: FrontEndOutput, pose: PoseEstimate | None, residuals: PlaneResiduals | None) -> None:
        """Take a tracked frame, its pose, and the residuals of the landmarks that left the window last."""
        if self._monitor is None:
            return
        if residuals is not None and residuals is not self._last:
            self._last = residuals
            self._monitor.add_residuals(residuals)
        if self._scale is not None and pose is not None and (piece := self._scale.add_frame(frame, pose)) is not None:
            self._monitor.add_scale(*piece)

    def begin_window(self) -> None:
        """Forget the piece of path under way: a new window does not go on with it."""
        if self._scale is not None:
            self._scale.clear()
