"""The camera–IMU time shift, watched while the scanner runs: gyroscope against the rotation that images say.

``t_imu = t_cam + timeshift``. With a shift that is wrong by δ the gyroscope's rotation between two frames belongs to another pair
of instants: it differs from the camera's by δ (ω₁ − ω₀), and by the gyroscope's bias. Both are found by least squares over the
last seconds. Qin and Shen (2018) put δ into the smoother, as a shift of the features; here it is measured beside it and, where it
is certain, corrected at its source, the synchroniser, so that every stage goes on with one clock and a good calibration is left
alone. The poses lean on the gyroscope, so that a part of δ hides; how much a correction changes what is seen tells how large that
part is (the secant method).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.geometry import so3_log
from vli_common.types import NANOSECONDS
from vli_frontend.config import TimeShiftConfig
from vli_frontend.synchroniser import ImuSegment

_LONGEST_STEP_NS = 100_000_000
_OUTLIER_RAD = 3e-3
"""A rotation between two frames that differs more is a pose's step, no shift."""
_LEAST_RATE_SPREAD = 0.02
"""rad/s: RMS of the changes of the angular rate below which the scanner turns too evenly to tell a shift."""
_RESPONSE = (0.25, 1.0)
"""Least and largest share of an error that shows."""
_CERTAIN_SIGMAS = 4.0
"""An error is looked for at every keyframe: three sigmas would come by chance."""
_CLEAR_SIGMAS = 8.0
"""A correction that was this clear tells the share."""
_SETTLED = 0.3
"""Share of the memory that must have gone by before a correction, the first or the next."""


@dataclass(frozen=True)
class TimeShift:
    """What is missing in the time shift: estimate and one sigma, seconds."""

    error_s: float
    sigma_s: float


class TimeShiftMonitor:
    """Sums up gyroscope against camera, pair of frames by pair, forgetting slowly.

    Args:
        config: see :class:`TimeShiftConfig`.
    """

    def __init__(self, config: TimeShiftConfig) -> None:
        self._config = config
        self._response = _RESPONSE[1]
        self._corrected: tuple[float, float] | None = None
        self.reset()

    def reset(self) -> None:
        """Forget what was seen: a new session, or another shift from now on."""
        self._information, self._vector, self._squares = np.zeros((4, 4)), np.zeros(4), 0.0
        self._weight, self._elapsed_s = 0.0, 0.0
        self._last: tuple[int, FloatArray] | None = None

    def previous_ns(self, stamp_ns: int) -> int | None:
        """Return the stamp of the frame before, if the two are near enough to be compared."""
        if self._last is None or not 0 < stamp_ns - self._last[0] <= _LONGEST_STEP_NS:
            return None
        return self._last[0]

    def add(self, stamp_ns: int, R_map_imu: FloatArray, segment: ImuSegment | None) -> None:
        """Take the attitude (3, 3) of a frame and the IMU since :meth:`previous_ns` (None: nothing to compare)."""
        if segment is not None and self._last is not None:
            elapsed = float(segment.stamps[-1] - segment.stamps[0]) / NANOSECONDS
            error = so3_log(self._last[1].T @ R_map_imu) - segment.mean_rate * elapsed
            self._sum_up(error, segment.gyro[-1] - segment.gyro[0], elapsed)
        self._last = stamp_ns, R_map_imu

    def estimate(self) -> TimeShift | None:
        """Return the shift's error, or None where the motion so far does not tell it."""
        spread = np.sqrt(self._information[0, 0] / max(self._weight, 1e-9))
        if self._elapsed_s < _SETTLED * self._config.memory_s or spread < _LEAST_RATE_SPREAD:
            return None
        covariance = np.linalg.inv(self._information)
        solution = covariance @ self._vector
        residual = max(self._squares - float(solution @ self._vector), 0.0)
        # Three rows a pair; neighbouring pairs share a frame, whose error enters both.
        variance = 2.0 * residual / max(3.0 * self._weight - 4.0, 1.0)
        return TimeShift(float(solution[0]), float(np.sqrt(variance * covariance[0, 0])))

    def correction_s(self) -> float:
        """Return by how much to change the shift now, seconds; zero where it is right, or not certain enough."""
        found = self.estimate()
        if found is None:
            return 0.0
        self._learn_response(found)
        error, sigma = found.error_s / self._response, found.sigma_s / self._response
        if abs(error) < max(self._config.least_s, _CERTAIN_SIGMAS * sigma):
            return 0.0
        self._corrected = (found.error_s, error) if abs(found.error_s) > _CLEAR_SIGMAS * found.sigma_s else None
        return error

    def _learn_response(self, found: TimeShift) -> None:
        """Compare what is seen now with what was seen before the last correction."""
        if self._corrected is not None:
            before, correction = self._corrected
            self._response = float(np.clip((before - found.error_s) / correction, *_RESPONSE))
            self._corrected = None

    def _sum_up(self, error: FloatArray, change: FloatArray, elapsed_s: float) -> None:
        """Add the rows error = δ change − bias elapsed, one for each axis."""
        kept = np.exp(-elapsed_s / self._config.memory_s)
        self._elapsed_s += elapsed_s
        self._information, self._vector = kept * self._information, kept * self._vector
        self._squares, self._weight = kept * self._squares, kept * self._weight
        if np.linalg.norm(error) > _OUTLIER_RAD + 0.05 * np.linalg.norm(change):
            return
        rows = np.column_stack([change, -elapsed_s * np.eye(3)])
        self._information = self._information + rows.T @ rows
        self._vector = self._vector + rows.T @ error
        self._squares += float(error @ error)
        self._weight += 1.0
