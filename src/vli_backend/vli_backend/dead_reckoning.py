"""Where the scanner may be while nothing tracks: carried by the IMU alone.

The gyroscope keeps attitude and heading to a milliradian; the position errs by centimetres within seconds. That is no pose to
publish, but the place from which a new window begins, and what a relocalisation on the map starts from.

How far it errs follows three errors, alike in all directions: a of the acceleration, v of the velocity, p of the position,

    p ← p + v t + ½ a t²,   v ← v + a t,

with what the preintegration says of gaps in the IMU on top; an error of the attitude turns gravity, and is one of a.
"""

from __future__ import annotations

from typing import cast

import gtsam
import numpy as np

from vli_backend.initialisation import GRAVITY
from vli_backend.smoother import KeyframeState
from vli_common.arrays import FloatArray
from vli_common.types import FrontEndOutput, Preintegration

_SIGMAS = np.array([1e-2, 2e-3, 0.0])
"""m/s², m/s and m: what is left of acceleration (tilt and bias), velocity and position when tracking ends."""
_UNKNOWN_SIGMA = 0.05
"""m: where the IMU says no more than this, the scanner may be anywhere within a hand's reach of where it was."""
_REMEMBERED = 64


class DeadReckoning:
    """Follows the front end's keyframes by their preintegration.

    Args:
        stamp_ns: newest keyframe that was tracked; None: nothing was tracked yet, the map begins here.
        state: at that keyframe.
    """

    def __init__(self, stamp_ns: int | None = None, state: KeyframeState | None = None) -> None:
        self._state = state
        self._begin_ns = self._keyframe_ns = stamp_ns
        self._T_map_imu = np.eye(4) if state is None else state.T_map_imu
        self._last_known = self._T_map_imu[:3, 3]
        self._keyframe_covariance = self._covariance = np.diag(_SIGMAS**2)
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
                self._carry(self._state, pim, frame.tracks.keyframe)
            elif frame.tracks.keyframe:
                self._interrupted = True
        if frame.tracks.keyframe:
            self._keyframe_ns = stamp
            self._poses[stamp] = self._place
            while len(self._poses) > _REMEMBERED:
                del self._poses[next(iter(self._poses))]

    def at(self, stamp_ns: int) -> FloatArray:
        """Return ``T_map_imu`` (4, 4) at a keyframe, else the newest; the last position that was known where none is now."""
        return self._poses.get(stamp_ns, self._place)

    @property
    def sigma_m(self) -> float:
        """One standard deviation of the newest position; 0 where the map begins."""
        if self._begin_ns is None:
            return 0.0
        return _UNKNOWN_SIGMA if self._interrupted else min(float(np.sqrt(self._covariance[2, 2])), _UNKNOWN_SIGMA)

    def elapsed_s(self, stamp_ns: int) -> float:
        """Return the seconds since tracking ended; 0 where the map begins."""
        return 0.0 if self._begin_ns is None else (stamp_ns - self._begin_ns) * 1e-9

    @property
    def _place(self) -> FloatArray:
        if self.sigma_m < _UNKNOWN_SIGMA:
            return self._T_map_imu
        result = self._T_map_imu.copy()
        result[:3, 3] = self._last_known
        return result

    def _carry(self, state: KeyframeState, preintegration: Preintegration, is_keyframe: bool) -> None:
        measurements = cast(gtsam.PreintegratedCombinedMeasurements, preintegration.measurements)
        predicted = measurements.predict(state.nav_state(), state.bias())
        self._T_map_imu = predicted.pose().matrix()
        t = measurements.deltaTij()
        step = np.array([[1.0, 0.0, 0.0], [t, 1.0, 0.0], [0.5 * t**2, t, 1.0]])
        self._covariance = step @ self._keyframe_covariance @ step.T + _of_gaps(preintegration, measurements)
        if is_keyframe:
            self._keyframe_covariance = self._covariance
            self._state = KeyframeState(self._T_map_imu, predicted.velocity(), state.gyro_bias, state.accel_bias)


def _of_gaps(preintegration: Preintegration, measurements: gtsam.PreintegratedCombinedMeasurements) -> FloatArray:
    """Return the covariance (3, 3) of acceleration, velocity and position that interpolating across gaps adds.

    What a gap turns is what it pushes: the three errors count as one, which is the most that they can come to.
    """
    if preintegration.inflate <= 1.0:
        return np.zeros((3, 3))
    # GTSAM's order is rotation, position, velocity.
    variances = np.diag(measurements.preintMeasCov())[:9].reshape(3, 3).mean(axis=1)
    sigmas = np.sqrt(variances[[0, 2, 1]]) * np.array([GRAVITY, 1.0, 1.0])
    result: FloatArray = np.outer(sigmas, sigmas)
    return result
