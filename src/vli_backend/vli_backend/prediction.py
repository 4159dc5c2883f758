"""Where the next frame will be: the start of its pose solution, and a weak prior on it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from vli_backend.smoother import KeyframeState
from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, orthonormalised, so3_exp, so3_log

_REST = (2e-4, 1e-4)
_IMU = (5e-4, 2e-4)
_IMU_GROWTH = (2e-3, 2e-2)
_NO_IMU = (0.02, 2e-3)
"""Sigmas (rad, m) of a prediction: at rest; with IMU, at once and per second; without, per period. Loose against features."""

_REACH_SIGMAS, _HAND_SPEED = 3.0, 1.0
"""How far off a prediction across a gap may be: in its sigmas, and at most by what a hand does, m/s."""


@dataclass(frozen=True)
class Prediction:
    """Predicted ``T_map_camera`` (4, 4), velocity (3,) of imu_link in map, information (6, 6) of [ω, v] in the camera."""

    T_map_camera: FloatArray
    velocity: FloatArray
    information: FloatArray
    reach_m: float = 0.0
    """How much farther off than a hand moves between two frames the prediction may be: it leads across a gap."""


class Predictor:
    """Carries the last frame's pose forward.

    The IMU is integrated from the last keyframe, but only its step since the last *frame* is used: an error of the keyframe's
    velocity or bias then counts over one frame, not over the whole interval.

    Args:
        T_imu_cam: (4, 4).
        blind_s: without an image for so long a prediction may be anywhere; over less, the small motion of a hand keeps it near.
    """

    def __init__(self, T_imu_cam: FloatArray, blind_s: float) -> None:
        self._T_imu_cam, self._blind_s = T_imu_cam, blind_s
        self._state: KeyframeState | None = None
        self._T_map_imu_predicted = np.eye(4)
        self._predicted_ns = 0
        self._frames: list[tuple[int, FloatArray]] = []

    def set_keyframe(self, stamp_ns: int, state: KeyframeState) -> None:
        """Restart the integration at a solved keyframe, which is also the newest frame."""
        self._state = state
        self._T_map_imu_predicted, self._predicted_ns = state.T_map_imu, stamp_ns
        self._frames = [*self._frames[-2:-1], (stamp_ns, state.T_map_imu @ self._T_imu_cam)]

    def observe(self, stamp_ns: int, T_map_camera: FloatArray) -> None:
        """Take the pose found for a frame."""
        self._frames = [*self._frames[-1:], (stamp_ns, T_map_camera)]

    @property
    def angular_velocity(self) -> FloatArray:
        """Angular velocity (3,) of imu_link in imu_link, from the last two frames, rad/s."""
        if len(self._frames) < 2:
            return np.zeros(3)
        (before_ns, before), (last_ns, last) = self._frames
        turn = so3_log(before[:3, :3].T @ last[:3, :3])
        result: FloatArray = self._T_imu_cam[:3, :3] @ turn / max((last_ns - before_ns) * 1e-9, 1e-6)
        return result

    def predict(
        self, stamp_ns: int, imu: gtsam.PreintegratedCombinedMeasurements | None, stationary: bool, inflate: float = 1.0
    ) -> Prediction:
        """Return the prediction for a frame.

        Args:
            stamp_ns: of the frame.
            imu: preintegration from the last keyframe to it, or None.
            stationary: True where the front end sees no motion.
            inflate: factor on the variances of the IMU, see :class:`vli_common.types.Preintegration`.
        """
        last_ns, last = self._frames[-1]
        if imu is None or self._state is None:
            return self._without_imu(stamp_ns, stationary)
        nav = imu.predict(self._state.nav_state(), self._state.bias())
        T_map_imu = nav.pose().matrix()
        step = inverse(self._T_map_imu_predicted) @ T_map_imu
        step_begins_ns, self._predicted_ns, self._T_map_imu_predicted = self._predicted_ns, stamp_ns, T_map_imu
        if stationary:
            return Prediction(last, np.zeros(3), _information(*_REST))
        if step_begins_ns != last_ns:
            # The frame before had no IMU: the step leads from an older frame, whose motion the last pose has already.
            return replace(self._without_imu(stamp_ns, stationary), velocity=nav.velocity())
        elapsed = (stamp_ns - last_ns) * 1e-9
        predicted = orthonormalised(last @ inverse(self._T_imu_cam) @ step @ self._T_imu_cam)
        rotation, position = ((s + growth * elapsed) * inflate**0.5 for s, growth in zip(_IMU, _IMU_GROWTH, strict=True))
        reach = self._reach(position, elapsed) if inflate > 1.0 else 0.0
        return Prediction(predicted, nav.velocity(), _information(rotation, position), reach)

    def _without_imu(self, stamp_ns: int, stationary: bool) -> Prediction:
        last_ns, last = self._frames[-1]
        if stationary or len(self._frames) < 2:
            return Prediction(last, np.zeros(3), _information(*(_REST if stationary else _NO_IMU)))
        return self._constant_velocity((stamp_ns - last_ns) * 1e-9)

    def _constant_velocity(self, elapsed: float) -> Prediction:
        (before_ns, before), (last_ns, last) = self._frames
        between = (last_ns - before_ns) * 1e-9
        ahead = min(elapsed / between, 3.0)
        turn = so3_log(before[:3, :3].T @ last[:3, :3])
        velocity = (last[:3, 3] - before[:3, 3]) / between
        predicted = last.copy()
        predicted[:3, :3] = last[:3, :3] @ so3_exp(ahead * turn)
        predicted[:3, 3] += velocity * ahead * between
        missed = max(elapsed / between, 1.0)
        rotation, position = (missed * sigma for sigma in _NO_IMU)
        return Prediction(predicted, velocity, _information(rotation, position), self._reach(position, elapsed))

    def _reach(self, sigma_m: float, elapsed_s: float) -> float:
        return min(_REACH_SIGMAS * sigma_m, _HAND_SPEED * elapsed_s) if elapsed_s > self._blind_s else 0.0


def _information(rotation: float, position: float) -> FloatArray:
    return np.diag(np.repeat([rotation**-2, position**-2], 3))
