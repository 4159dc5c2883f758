"""A solved batch of camera and IMU: its states, and the covariance of what is calibrated."""

from __future__ import annotations

import gtsam
import numpy as np

from vli_calibration.imu_camera_states import A, D, E, FrameStates, G, RigState, b_key, v_key, x_key
from vli_common.arrays import FloatArray

_STATE = 15
_STATE_COLUMNS = {"x": slice(0, 6), "v": slice(6, 9), "b": slice(9, 15)}
_SHARED = {A: slice(0, 1), G: slice(1, 4), D: slice(4, 5), E: slice(5, 11)}
_SHARED_SIZE = 11


class Solution:
    """A solved graph; covariances on demand."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, rig: RigState, fallen_s: FloatArray) -> None:
        self.graph, self.values = graph, values
        self._before, self._fallen_s = rig, fallen_s
        self.timeshift_step_s = float(values.atVector(D)[0])
        self.gravity_step = float(values.atVector(A)[0])

    @property
    def rig(self) -> RigState:
        """The shared unknowns with the steps of this solution added."""
        return RigState(
            self.values.atPose3(E).matrix(),
            self.values.atRot3(G).matrix(),
            self._before.timeshift_s + self.timeshift_step_s,
            self._before.gravity + self.gravity_step,
        )

    @property
    def frames(self) -> FrameStates:
        """The frames' states in the world that rests, at the camera's new time."""
        poses, velocities, biases = [], [], []
        for index, seconds in enumerate(self._fallen_s.tolist()):
            T, velocity = self.values.atPose3(x_key(index)).matrix(), self.values.atVector(v_key(index))
            T[2, 3] -= 0.5 * self.gravity_step * seconds**2
            velocity[2] -= self.gravity_step * seconds
            T[:3, 3] += self.timeshift_step_s * velocity
            poses.append(T)
            velocities.append(velocity)
            biases.append(self.values.atConstantBias(b_key(index)).vector())
        return FrameStates(np.array(poses), np.array(velocities), np.array(biases))

    def covariance(self) -> FloatArray:
        """Return the covariance (8, 8) of T_cam_imu (right perturbation [ω, v]), time offset and gravity."""
        root = _shared_root(self.graph.linearize(self.values), len(self._fallen_s))
        inverse_root = np.linalg.solve(root, np.eye(len(root)))
        wanted = np.r_[_SHARED[E], _SHARED[D], _SHARED[A]]
        result: FloatArray = (inverse_root @ inverse_root.T)[np.ix_(wanted, wanted)]
        return result


def _shared_root(linear: gtsam.GaussianFactorGraph, count: int) -> FloatArray:
    """Return the triangular root (11, 11) of the information about what all frames share, by QR from frame to frame.

    GTSAM's marginals go by Cholesky, see :meth:`Batch.solve`.
    """
    rows: list[list[FloatArray]] = [[] for _ in range(count)]
    for number in range(linear.size()):
        factor = linear.at(number)
        symbols = [gtsam.Symbol(key) for key in factor.keys()]  # noqa: SIM118
        frame = min((symbol.index() for symbol in symbols if chr(symbol.chr()) in _STATE_COLUMNS), default=0)
        matrix = factor.jacobian()[0]
        wide, column = np.zeros((len(matrix), 2 * _STATE + _SHARED_SIZE)), 0
        for symbol in symbols:
            place = _columns(symbol, frame)
            width = place.stop - place.start
            wide[:, place] = matrix[:, column : column + width]
            column += width
        rows[frame].append(wide)
    carried = np.zeros((0, 2 * _STATE + _SHARED_SIZE))
    for frame_rows in rows:
        triangle = np.linalg.qr(np.vstack([carried, *frame_rows]))[1][_STATE:]
        carried = np.zeros_like(triangle)
        carried[:, :_STATE] = triangle[:, _STATE : 2 * _STATE]
        carried[:, 2 * _STATE :] = triangle[:, 2 * _STATE :]
    return np.linalg.qr(carried[:, 2 * _STATE :])[1]


def _columns(symbol: gtsam.Symbol, frame: int) -> slice:
    """Return where a key's columns go: this frame's state, the next one's, what is shared."""
    place = _STATE_COLUMNS.get(chr(symbol.chr()))
    if place is None:
        shared = _SHARED[int(symbol.key())]
        return slice(2 * _STATE + shared.start, 2 * _STATE + shared.stop)
    offset = _STATE * (symbol.index() - frame)
    return slice(offset + place.start, offset + place.stop)
