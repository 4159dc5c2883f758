"""Where the scanner may be while nothing tracks: carried by the IMU alone.

The gyroscope keeps attitude and heading to a milliradian; the position errs by centimetres within seconds. That is no pose to
publish, but the place from which a new window begins, and what a relocalisation on the map starts from.
"""

from __future__ import annotations

from typing import cast

import gtsam
import numpy as np

from vli_backend.smoother import KeyframeState
from vli_common.arrays import FloatArray
from vli_common.types import FrontEndOutput

_VELOCITY_SIGMA = 2e-3
_ACCELERATION_SIGMA = 1e-2
"""m/s and m/s²: what is left of velocity, and of tilt and bias, when tracking ends."""
_UNKNOWN_SIGMA = 0.1
"""m: where the IMU, too, was interrupted, the scanner may be anywhere within a hand's reach."""
_REMEMBERED = 64


class DeadReckoning:
    """Follows the front end's keyframes by their preintegration.

    Args:
        stamp_ns: newest keyframe of the window that ended; None: nothing was tracked yet, the map begins here.
        state: at that keyframe.
    """

    def __init__(self, stamp_ns: int | None = None, state: KeyframeState | None = None) -> None:
        self._state = state
        self._begin_ns = self._keyframe_ns = stamp_ns
        self._T_map_imu = np.eye(4) if state is None else state.T_map_imu
        self._poses: dict[int, FloatArray] = {}
        self._interrupted = False

    @property
    def is_origin(self) -> bool:
        """True where nothing was tracked before: the map begins here."""
        return self._begin_ns is None

    def add_frame(self, frame: FrontEndOutput) -> None:
        """Carry the state to a frame; a keyframe is where the next interval begins."""
        stamp, pim = frame.tracks.stamp_ns, frame.preintegration
        if self._state is not None and not self._interrupted:
            if pim is not None and pim.from_ns == self._keyframe_ns:
                self._carry(cast(gtsam.PreintegratedCombinedMeasurements, pim.measurements), frame.tracks.keyframe)
            elif frame.tracks.keyframe:
                self._interrupted = True
        if frame.tracks.keyframe:
            self._keyframe_ns = stamp
            self._poses[stamp] = self._T_map_imu
            while len(self._poses) > _REMEMBERED:
                del self._poses[next(iter(self._poses))]

    def at(self, stamp_ns: int) -> FloatArray:
        """Return ``T_map_imu`` (4, 4) at a keyframe, else the newest."""
        return self._poses.get(stamp_ns, self._T_map_imu)

    def sigma_m(self, stamp_ns: int) -> float:
        """Return one standard deviation of the position at a stamp; 0 where the map begins."""
        if self._begin_ns is None:
            return 0.0
        if self._interrupted:
            return _UNKNOWN_SIGMA
        elapsed = (stamp_ns - self._begin_ns) * 1e-9
        return float(min(np.hypot(_VELOCITY_SIGMA * elapsed, 0.5 * _ACCELERATION_SIGMA * elapsed**2), _UNKNOWN_SIGMA))

    def elapsed_s(self, stamp_ns: int) -> float:
        """Return the seconds since tracking ended; 0 where the map begins."""
        return 0.0 if self._begin_ns is None else (stamp_ns - self._begin_ns) * 1e-9

    def _carry(self, measurements: gtsam.PreintegratedCombinedMeasurements, is_keyframe: bool) -> None:
        if self._state is None:
            return
        predicted = measurements.predict(self._state.nav_state(), self._state.bias())
        self._T_map_imu = predicted.pose().matrix()
        if is_keyframe:
            self._state = KeyframeState(self._T_map_imu, predicted.velocity(), self._state.gyro_bias, self._state.accel_bias)
